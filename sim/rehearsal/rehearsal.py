"""The common part of all rehearsals: a world under virtual time in which one app runs on all robots."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from services.apps import loader
from services.apps.equipment.speaker import prints_heard
from services.apps.host.event_host import EventHost
from services.apps.host.lockstep_driver import LockstepDriver
from services.apps.host.observer import Observer
from services.mesh.links.radio_model import AirModel
from sim.core import actions
from sim.scenario.options import PRESS_S, SETTLED
from sim.virtual.world import Launch, MakeRunner, VirtualWorld
from swarm.app.run_options import RunOptions
from swarm.config import Config
from swarm.errors import AppError
from swarm.messages import AppLog, Measurement
from swarm.messages.codec import Value

Measure = Callable[[str, int], Measurement]
"""What gives the measurement of a robot's step k: `measure(robot, k)`."""

Said = Callable[[str, AppLog], None]
"""What hears each line that an app prints or logs: `said(robot, line)`."""


class RehearsedRobot:
    """One robot of a rehearsal."""

    def __init__(self, world: VirtualWorld, name: str, app: str) -> None:
        self.name = name
        self._world = world
        self._app = app

    @property
    def host(self) -> LockstepDriver | EventHost:
        """The shell that runs the app, as in a process on a robot."""
        host = self._world.robots[self.name].apps[self._app]
        return host if isinstance(host, EventHost) else host.drivers[""]

    @property
    def app(self) -> Any:
        """The instance of the author's class."""
        return self.host.runner.app

    @property
    def fault(self) -> str:
        """Why the app, or the lockstep of one of its channels, ended; empty while all run."""
        return self.host.progress.reason if self.host.failed else ""

    @prints_heard()
    def press(self, button: str) -> None:
        """Press the button "a", "b" or "c". Raises `LocalError` for another one."""
        self._world.act(self.name, actions.check(actions.Press(button.upper(), PRESS_S)))

    def result(self) -> Mapping[str, Value]:
        """Return the robot's present result."""
        return self.host.runner.result()


class Rehearsal:
    """Robots that run an app, each with its mesh; links lose nothing and have one latency."""

    @prints_heard()
    def __init__(
        self,
        app: loader.LoadedApp,
        config: Config,
        latency: float,
        *,
        seed: int = 1,
        measure: Measure | None = None,
        observer: Observer | None = None,
        runner: MakeRunner | None = None,
        said: Said | None = None,
        mesh: str = SETTLED,
    ) -> None:
        """`latency` of the links, s; `mesh`: one of `options.MESHES`. `measure(robot, k)` gives the measurement of
        step k to an app that wants one. `runner(app, source)` makes what calls the author's methods."""
        self.world = VirtualWorld(config, AirModel(latency, 0.0, None, seed), seed, mesh=mesh)
        self.units = {name: RehearsedRobot(self.world, name, app.name) for name in config.names}
        if said is not None:
            self.world.hearers = {(name, app.name): [partial(said, name)] for name in config.names}
        for name in config.names:
            rows = None if measure is None else partial(measure, name)
            self.world.start_app(name, Launch(app, 1, RunOptions(), rows, observer, runner))

    @property
    def now(self) -> float:
        """Return the seconds since the start."""
        return self.world.time.now

    def result(self, name: str) -> Mapping[str, Value]:
        """Return a robot's present result."""
        return self.units[name].result()

    def _pass(self, until: float) -> None:
        """Let time pass until `until`, s since the start. Raises `AppError` where an app has failed."""
        self.world.time.run(until)
        for unit in self.units.values():
            if unit.fault:
                raise AppError(unit.fault)
