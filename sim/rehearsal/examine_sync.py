"""The examination of a synchronous app on one graph."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import count
from typing import Any

from services.apps.runner import UNDECIDED, Runner
from sim.rehearsal import tracing, trends
from sim.rehearsal.examine_report import GraphFinding, Task, cut_short, digest, make_all, write_line
from sim.rehearsal.limits import Stopwatch, limited
from sim.rehearsal.sync import ITERATION_S, SyncRehearsal
from sim.scenario.options import DELAY, SETTLED
from swarm.app.mesh_clock import MeshClock
from swarm.app.sync_app import SyncApp
from swarm.errors import AppError
from swarm.messages import Clock, Measurement
from swarm.messages.codec import Value

Act = Callable[[], tuple[bytes, bytes]]
"""One step from the same state each time: the next state, shared and private."""


def examine_sync(task: Task, finding: GraphFinding) -> None:
    """Run the app, with mere delays for links as long as it sends no messages of its own: that is twice as fast."""
    try:
        _Examination(task, finding, DELAY).run()
    except _NeedsMesh:
        finding.digests.clear()
        _Examination(task, finding, SETTLED).run()


class _NeedsMesh(BaseException):
    """The app wants to send messages. No `Exception`: an author's own `except` must not swallow it."""


class _NoMesh:
    """What stands for the messages of a mesh that is not there."""

    def __getattr__(self, name: str) -> Any:
        raise _NeedsMesh


class _Noted:
    """The messages of a robot, and whether the app has sent one or looked for one."""

    def __init__(self, overlays: object) -> None:
        self.used = False
        self._overlays = overlays

    def __getattr__(self, name: str) -> Any:
        self.used = True
        return getattr(self._overlays, name)


class _Examination:
    """One run on one graph, in which each step is done several times."""

    def __init__(self, task: Task, finding: GraphFinding, mesh: str) -> None:
        self.source = task.app.source
        self.mesh = mesh
        self.states: dict[str, list[bytes]] = {}
        """The shared states of each robot, by iteration."""
        self._task, self._finding = task, finding
        self._times: list[float] = []
        """CPU time of each step, s."""
        self._orders: set[str] = set()
        """Robot and iteration of a step that depends on the order of the neighbours."""
        self._sums: set[tuple[str, int]] = set()
        """File and line of each call of `sum` with floats."""

    def run(self) -> None:
        """Do all iterations, as far as there is time for them."""
        task, finding = self._task, self._finding
        config = task.config(finding.graph)
        make_all(task.app, config)
        swarm = SyncRehearsal(
            task.app,
            config,
            mesh=self.mesh,
            runner=lambda app, source: _ExaminedRunner(app, source, self),
            said=write_line,
        )
        watch = Stopwatch()
        try:
            while swarm.k < task.iterations and not watch.spent:
                finding.digests.append(digest([self.states[name][swarm.k] for name in swarm.names]))
                swarm.run(1)
        finally:
            finding.seconds, finding.iterations = ITERATION_S * swarm.k, swarm.k
            finding.note([unit.app for unit in swarm.units.values()], self._times)
        if swarm.k < task.iterations:
            cut_short(finding, watch, f"{swarm.k} of {task.iterations} iterations")
        finding.trend = trends.judge({name: swarm.results[name] for name in swarm.names})
        if self._orders:
            where = min(self._orders)
            finding.warnings.append(
                f"the result depends on the order of the neighbours ({where}): they always come sorted by name"
            )
        finding.warnings += [
            f"{file}, line {line}: sum() rounds floats differently from Python 3.12 on; use math.fsum"
            for file, line in sorted(self._sums)
        ]

    def step(self, runner: "_ExaminedRunner", act: Act, neighbours: int) -> tuple[bytes, bytes]:
        """Do a step by `act()`, and again from the same state."""
        finding, source, watch = self._finding, self.source, Stopwatch()
        step_line = tracing.line_of(type(runner.app), "step")
        try:
            done = limited(source, act)
        except AppError as error:
            finding.fault = str(error)
            vague = f"{source}, from line {step_line} on: "
            if vague in finding.fault and (line := tracing.bad_line(runner, source, act)):
                finding.fault = finding.fault.replace(vague, f"{source}, line {line}: ")
            elif f"{source}, " not in finding.fault:
                finding.line = step_line
            raise
        self._times.append(watch.computed)
        if runner.messages.used:  # a message arrives once: a second step cannot see it again
            return done
        where = f"{type(runner.app).__name__} on {runner.app.robot.name}, iteration {runner.k - 1}"
        with tracing.float_sums() as found:
            again = limited(source, act)
        self._sums |= found
        if again != done:
            finding.fault = f"{where}: the same step gave two results: it is not a function of its inputs"
            finding.line = tracing.differing_line(runner, source, act) or step_line
            raise AppError(finding.fault)
        if neighbours > 1 and not self._orders and not _near(runner, done, lambda: _reversed_step(runner, act)):
            self._orders.add(where)
        act()
        return done

    def ask(self, runner: "_ExaminedRunner") -> None:
        """Let an app say whether it has converged, as a run with `--until converged` does after each step."""
        try:
            limited(self.source, runner.content)
        except AppError as error:
            self._finding.fault = str(error)
            raise
        line = tracing.line_of(type(runner.app), "converged")
        if runner.undecided and (warning := f"{self.source}, line {line}: {UNDECIDED}") not in self._finding.warnings:
            self._finding.warnings.append(warning)


class _ExaminedRunner(Runner):
    """Drives the app of one robot, and ends a method that takes too long."""

    def __init__(self, app: SyncApp, source: str, examination: _Examination) -> None:
        super().__init__(app, source)
        self._examination = examination
        self._private = b""
        self.messages = _Noted(app.robot.overlays)
        robot: Any = app.robot
        robot.overlays = _NoMesh() if examination.mesh == DELAY else self.messages
        robot.time = partial(_later, robot.time, count(1))
        robot.mesh_clock = MeshClock(robot.bus, robot.name, robot.time)
        robot.mesh_clock.state = Clock(t=0.0, offset=0.0, rate=0.0, root=robot.name, hop=0, error=0.0)

    def start(self, measurement: Measurement | None) -> tuple[bytes, bytes]:
        own, self._private = limited(self.source, lambda: Runner.start(self, measurement))
        self._examination.states[self.app.robot.name] = [own]
        return own, self._private

    def step(
        self, k: int, own: bytes, values: Mapping[str, bytes], measurement: Measurement | None
    ) -> tuple[bytes, bytes]:
        before, graph = self._private, self.app.robot.graph

        def act() -> tuple[bytes, bytes]:
            self.restore(k, own, before, graph)
            return Runner.step(self, k, own, values, measurement)

        done = self._examination.step(self, act, len(values))
        if type(self.app).converged is not SyncApp.converged:
            self._examination.ask(self)
        self._private = done[1]
        self._examination.states[self.app.robot.name].append(done[0])
        return done

    def result(self) -> dict[str, Value]:
        return limited(self.source, lambda: Runner.result(self))


def _later(now: Callable[[], float], looks: Iterator[int]) -> float:
    """Return the time, later at each look, as on a robot."""
    return now() + 1e-6 * next(looks)


def _reversed_step(runner: Runner, act: Act) -> tuple[bytes, bytes]:
    """Do the step with the neighbours in reverse order."""
    app = runner.app
    plain = app.step
    object.__setattr__(app, "step", lambda neighbours: plain(neighbours[::-1]))
    try:
        return act()
    finally:
        object.__delattr__(app, "step")


def _near(runner: Runner, done: tuple[bytes, bytes], other: Act) -> bool:
    """Return whether two states are the same but for the rounding of a sum in another order."""
    again = other()
    if again == done:
        return True
    numbers = [trends.numbers(runner.schema.unpack(state)) for state in (done[0], again[0])]
    scale = max((abs(x) for x in numbers[0]), default=0.0)
    return all(abs(a - b) <= 1e-6 * scale + 1e-12 for a, b in zip(*numbers, strict=True))
