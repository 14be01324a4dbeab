"""A rehearsal of one synchronous app, in which an iteration takes 0.1 s of virtual time."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from numbers import Integral

from services.apps import loader
from services.apps.equipment.speaker import prints_heard
from services.apps.host.observer import Source, StepRecord
from sim.rehearsal.rehearsal import Measure, Rehearsal, Said
from sim.rehearsal.scene import measurement
from sim.scenario.options import SETTLED
from sim.virtual.bus import VirtualBus
from sim.virtual.world import MakeRunner
from swarm.app.sync_app import SyncApp
from swarm.config import Config
from swarm.errors import AppError, LocalError
from swarm.messages import AppEpoch, AppParameters, SetAppEpoch
from swarm.messages.codec import Value
from swarm.messages.keys import key

ITERATION_S = 0.1
"""Seconds of virtual time that an iteration takes, which is the latency of the links."""

STALLED_S = 20.0
"""Seconds of virtual time without an iteration after which a rehearsal is given up."""


class SyncRehearsal(Rehearsal):
    """`results[name][k]` is what a robot reports at iteration k."""

    @prints_heard()
    def __init__(
        self,
        app: loader.LoadedApp,
        config: Config,
        *,
        seed: int = 1,
        measure: Measure = measurement,
        runner: MakeRunner | None = None,
        said: Said | None = None,
        mesh: str = SETTLED,
    ) -> None:
        """`measure(robot, k)` gives the measurement of step k to an app that wants one. `runner(app, source)` makes
        what drives the app of each robot. `said(robot, line)` is called with what apps print and log. `mesh`: one of
        `options.MESHES`."""
        kind = app.kind_on(config, config.names[0])
        if not issubclass(kind, SyncApp):
            raise AppError(f"{app.source}: {kind.__name__} is no SyncApp")
        self.names = config.names
        self.results: dict[str, list[Mapping[str, Value]]] = {name: [] for name in config.names}
        self._app = app.name

        super().__init__(
            app,
            config,
            ITERATION_S,
            seed=seed,
            measure=lambda name, k: replace(measure(name, k), sequence=k),
            observer=self,
            runner=runner,
            said=said,
            mesh=mesh,
        )
        self.k = 0
        """The present iteration."""
        # Time passes by whole iterations from here on, so it always ends half way between the iterations of all robots.
        self._pass(ITERATION_S / 2)
        self._run_until(lambda: self._reached >= 0)

    @prints_heard()
    def run(self, iterations: int = 1) -> None:
        """Do so many more iterations. Raises `AppError` where the app of a robot has failed, or waits for ever, and
        `LocalError` for a number that is not whole, or below zero."""
        if not isinstance(iterations, Integral) or iterations < 0:
            raise LocalError(f"run: expected a number of iterations, got {iterations!r}")
        last = self.k + iterations
        self._run_until(lambda: self._reached >= last)
        self.k = last

    @prints_heard()
    def drop(self, robot: str) -> None:
        """Have the others go on without a robot, as `swarm mesh epoch drop` does: `on_epoch` of their apps is called.
        They do iterations anew that not all of them had done. Raises `LocalError` for a robot that is not there."""
        if robot not in self.names or len(self.names) == 1:
            raise LocalError(f"drop: expected one of several robots, {', '.join(self.names)}; got {robot!r}")
        left = tuple(name for name in self.names if name != robot)
        order = SetAppEpoch(f"drop {robot}", (robot,), (), force=False)
        VirtualBus(self.world.robots[left[0]].router).publish(key(left[0], f"app/{self._app}", "set", "epoch"), order)
        self._run_until(lambda: self.names == left)
        self.k = self._reached

    def result(self, name: str) -> Mapping[str, Value]:
        """Return a robot's result at iteration `k`."""
        return self.results[name][self.k]

    @property
    def _reached(self) -> int:
        """The iteration that all robots have done; -1 before all have begun."""
        return min(len(self.results[name]) for name in self.names) - 1

    def _run_until(self, there: Callable[[], bool]) -> None:
        last, since = self._reached, self.now
        while not there():
            self._pass(self.now + ITERATION_S)
            if self._reached > last:
                last, since = self._reached, self.now
            elif self.now - since > STALLED_S:
                progress = next(unit.host.progress for unit in self.units.values())
                raise AppError(f"no iteration for {STALLED_S:g} s: {progress.reason or progress.phase}")

    # What an `Observer` hears

    def advanced(self, source: Source, line: StepRecord) -> None:
        self.results[source.robot][line.k :] = [line.result]

    def progressed(self, source: Source) -> None:
        """Do nothing: `advanced` is called for each iteration."""

    def ended(self, source: Source) -> None:
        """Do nothing: `_pass` raises the error of a robot that has failed."""

    def switched(self, source: Source, epoch: AppEpoch) -> None:
        del self.results[source.robot][epoch.k :]
        self.names = tuple(name for name in self.names if name in epoch.members)

    def parameters(self, robot: str, parameters: AppParameters) -> None:
        """Do nothing: in a rehearsal nobody changes parameters."""
