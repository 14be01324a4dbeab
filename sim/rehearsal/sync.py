"""A swarm of one synchronous app, all robots in this process, step by step: no thread, no link.

What a robot has besides, its body, LEDs, poses and ranges, is that of virtual time, in which an iteration takes 0.1 s.
"""

import logging
from collections.abc import Callable, Mapping
from functools import partial

from services.apps import loader
from services.apps.equipment.equipment import equip
from services.apps.equipment.speaker import let_speak, prints_heard
from services.apps.runner import Runner
from services.mesh.links.radio_model import AirModel
from sim.rehearsal.messages import RehearsalOverlays
from sim.rehearsal.scene import measurement
from sim.scenario.options import DELAY
from sim.virtual.bus import VirtualBus
from sim.virtual.world import VirtualWorld
from swarm.app.sync_app import SyncApp
from swarm.config import Config
from swarm.core.graph import Graph
from swarm.errors import AppError
from swarm.messages import AppLog, Clock, Measurement
from swarm.messages.codec import Value

Measure = Callable[[str, int], Measurement]

ITERATION_S = 0.1
"""Seconds of virtual time that an iteration takes."""

_SILENT = logging.getLogger("rehearsal")
"""The logger of apps to whose lines nobody listens."""
_SILENT.addHandler(logging.NullHandler())
_SILENT.propagate = False


class SyncRehearsal:
    """`results[name][k]` is what a robot reports at iteration k, `states[name][k]` its packed shared state."""

    @prints_heard()
    def __init__(
        self,
        app: loader.LoadedApp,
        config: Config,
        *,
        seed: int = 1,
        measure: Measure = measurement,
        runner: type[Runner] = Runner,
        said: Callable[[str, AppLog], None] | None = None,
    ) -> None:
        """`measure(robot, k)` gives the measurement of step k to an app that wants one. `runner` drives the app of each
        robot. `said(robot, line)` is called with what apps print and log."""
        self.k = 0
        self.names = config.names
        self.graph = config.graph
        self._measure = measure
        self._looks = 0
        self.runners: dict[str, Runner] = {}
        self.messages: dict[str, RehearsalOverlays] = {}
        self._world = VirtualWorld(config, AirModel(0.0, 0.0, None, seed), seed, mesh=DELAY)
        for name in self.names:
            instance = app.make(config, name, seed)
            if not isinstance(instance, SyncApp):
                raise AppError(f"{app.source}: {type(instance).__name__} is no SyncApp")
            self.messages[name] = RehearsalOverlays(
                name, self.names, lambda to, message: self.messages[to].receive(message)
            )
            bus = VirtualBus(self._world.robots[name].router)
            equip(instance.robot, bus, _SILENT, self._now)
            if said is not None:
                let_speak(instance.robot, bus, None, partial(said, name))
            instance.robot.overlays = self.messages[name]  # type: ignore[assignment]
            # All robots have the very same time.
            instance.robot.clock.state = Clock(t=0.0, offset=0.0, rate=0.0, root=self.names[0], hop=0, error=0.0)
            instance.robot.truth = self._world.truth(name, app.name, type(instance))
            self.runners[name] = runner(instance, app.source)
        self.private: dict[str, bytes] = {}
        self.states: dict[str, list[bytes]] = {}
        self.results: dict[str, list[dict[str, Value]]] = {}
        for name, each in self.runners.items():
            own, self.private[name] = each.start(self.measured(name))
            self.states[name] = [own]
            self.results[name] = [each.result()]

    def measured(self, name: str) -> Measurement | None:
        """Return the measurement for a robot's next step."""
        return self._measure(name, self.k) if type(self.runners[name].app).measured else None

    def around(self, name: str) -> dict[str, bytes]:
        """Return the neighbours' states of this iteration."""
        return {near: self.states[near][self.k] for near in self.graph.neighbours(name)}

    @prints_heard()
    def run(
        self, iterations: int = 1, step: "Callable[[SyncRehearsal, str], tuple[bytes, bytes]] | None" = None
    ) -> None:
        """Do so many iterations; `step(self, robot)` takes the place of the plain step."""
        for _ in range(iterations):
            done = {name: (step or SyncRehearsal.step)(self, name) for name in self.names}
            self.k += 1
            self._pass()
            for name, (own, private) in done.items():
                self.states[name].append(own)
                self.private[name] = private
                self.results[name].append(self.runners[name].result())

    @prints_heard()
    def change(self, graph: Graph) -> None:
        """Go over to other members and links now, as a swarm does that drops a robot: `on_epoch` of the app."""
        self.graph, self.names = graph, graph.names
        for name in self.names:
            own, self.private[name] = self.runners[name].renew(
                self.k, self.k, self.states[name][self.k], self.private[name], graph
            )
            self.states[name][self.k] = own

    def step(self, name: str) -> tuple[bytes, bytes]:
        """Compute one robot's step: its next state, shared and private."""
        return self.runners[name].step(self.k, self.states[name][self.k], self.around(name), self.measured(name))

    def _pass(self) -> None:
        """Let the bodies do what they were told, until the next iteration."""
        self._world.time.run(ITERATION_S * self.k)
        for runner in self.runners.values():
            devices = runner.app.robot.devices
            if devices is not None and devices.next_deadline() is not None:
                devices.handle_timer()

    def _now(self) -> float:
        """Return the time, later at each call, as on a robot."""
        self._looks += 1
        return ITERATION_S * self.k + 1e-6 * self._looks

    def result(self, name: str) -> Mapping[str, Value]:
        """Return a robot's present result."""
        return self.results[name][-1]
