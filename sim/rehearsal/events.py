"""A swarm of one event-driven or periodic app under virtual time, with links that take 30 ms and lose nothing."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from services.apps import loader
from services.apps.equipment.speaker import prints_heard
from services.apps.host.event_host import EventHost
from services.mesh.links.radio_model import AirModel
from sim.core import actions
from sim.scenario.options import PRESS_S, SETTLED
from sim.virtual.world import Launch, MakeRunner, VirtualWorld
from swarm.app.event_app import EventApp
from swarm.app.run_options import RunOptions
from swarm.config import Config
from swarm.errors import AppError
from swarm.messages import AppLog
from swarm.messages.codec import Value

LATENCY = 0.03
"""Seconds that a message takes to a neighbour."""


class RehearsedRobot:
    """One robot of a rehearsal."""

    def __init__(self, world: VirtualWorld, name: str, app: str) -> None:
        self.name = name
        self._world = world
        self._app = app

    @property
    def host(self) -> EventHost:
        """The shell that runs the app, as in a process on a robot."""
        host = self._world.robots[self.name].apps[self._app]
        assert isinstance(host, EventHost)
        return host

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
        """Press the button "a", "b" or "c"."""
        self._world.act(self.name, actions.Press(button.upper(), PRESS_S))

    def result(self) -> Mapping[str, Value]:
        """Return the robot's present result."""
        return self.host.runner.result()


class EventRehearsal:
    """Runs an app on all robots of a configuration."""

    @prints_heard()
    def __init__(
        self,
        app: loader.LoadedApp,
        config: Config,
        runner: MakeRunner | None = None,
        said: Callable[[str, AppLog], None] | None = None,
    ) -> None:
        """`runner(app, source)` makes what calls the app's handlers, in place of an `EventRunner`. `said(robot, line)`
        is called with what apps print and log."""
        instance = app.make(config, config.names[0], seed=1)
        if not isinstance(instance, EventApp):
            raise AppError(f"{app.source}: {type(instance).__name__} is no EventApp or PeriodicApp")
        self.world = VirtualWorld(config, AirModel(LATENCY, 0.0, None, 1), 1, mesh=SETTLED)
        self.units = {name: RehearsedRobot(self.world, name, app.name) for name in config.names}
        if said is not None:
            self.world.hearers = {(name, app.name): [partial(said, name)] for name in config.names}
        launch = Launch(app, 1, RunOptions(), None, None, runner)
        for name in config.names:
            self.world.start_app(name, launch)

    @property
    def now(self) -> float:
        """Return the seconds since the start."""
        return self.world.time.now

    @prints_heard()
    def run(self, until: float) -> None:
        """Let time pass until `until`, s since the start."""
        self.world.time.run(until)
