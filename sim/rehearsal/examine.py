"""What `swarm check` has a process of its own find out about an app: the process may hang, or hash differently.

    python -m sim.rehearsal.examine FILE --robots 6 --iterations 300

It prints one JSON object a line: what the app declares, then what came of each graph.
"""

import argparse
import json
import signal
import sys
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, TypeVar

from services.apps import loader
from services.apps.event_runner import EventRunner
from services.apps.runner import Runner
from sim.rehearsal import tracing, trends
from sim.rehearsal.events import EventRehearsal
from sim.rehearsal.scene import scene
from sim.rehearsal.sync import SyncRehearsal
from swarm.app import settings
from swarm.app.event_app import PeriodicApp, channels_of
from swarm.app.settings import Setting
from swarm.app.sync_app import BaseApp as AnyApp
from swarm.app.sync_app import SyncApp
from swarm.config import Config
from swarm.core.asynchronous import HandlerCall, NeighbourState
from swarm.errors import AppError, LocalError
from swarm.frozen import frozen
from swarm.messages.codec import Value

T = TypeVar("T")

GRAPHS = ("line", "loop", "thesis-d", "full", "random:1")
"""Standard graphs; thesis-d is one of six robots."""

STEP_LIMIT = 2.0
"""s of computing after which a step hangs. The longest of ours takes some ms. Of CPU time, since what else the machine
does is no fault of the app."""

TIME_LIMIT = 8.0
"""s of CPU time that one graph may take; what has been done by then is judged."""

WAIT_LIMIT = 20.0
"""s by the clock after which a step hangs, and a graph ends, that waits for something instead of computing."""

SECONDS = 20.0
"""Virtual time of an event-driven or periodic app."""

FRAME = 18
"""Bytes that mesh and lockstep add to a state on an authenticated link (docs/frames.md)."""


ALARMS = (signal.SIGPROF, signal.SIGALRM)
"""What ends a step: it has computed, or waited, for too long."""


class Hang(BaseException):
    """A step took too long. No `Exception`: an author's own `except` must not swallow it."""

    def __init__(self, line: int, why: str) -> None:
        super().__init__(line, why)
        self.line, self.why = line, why


@frozen
class Task:
    """What is to be examined."""

    app: loader.LoadedApp
    robots: int = 6
    iterations: int = 300
    settings: Sequence[Setting] = ()

    @property
    def kind(self) -> type[AnyApp]:
        """The class that runs."""
        chosen = {one.name: one.value for one in self.settings if one.name == "algorithm"}
        return self.app.choose(chosen)[0]

    def scene(self, graph: str) -> Config:
        """The swarm on one graph."""
        common = {one.name: one.value for one in self.settings if one.robot is None}
        single: dict[str, dict[str, Value]] = {}
        for one in self.settings:
            if one.robot is not None:
                single.setdefault(one.robot, {})[one.name] = one.value
        return scene(self.app, self.robots, graph, common, single)


@dataclass
class _Finding:
    """What came of one graph."""

    graph: str
    fault: str = ""
    line: int | None = None
    warnings: list[str] = field(default_factory=list)
    iterations: int = 0
    step_mean: float = 0.0
    """s of CPU time on this machine."""
    step_worst: float = 0.0
    trend: dict[str, object] = field(default_factory=dict)
    """See `trends.judge`."""
    digests: list[int] = field(default_factory=list)
    """Checksum of all robots' states, by iteration: must be the same in another process."""


def main(arguments: list[str]) -> int:
    """Examine one app."""
    parser = argparse.ArgumentParser(prog="python -m sim.rehearsal.examine")
    parser.add_argument("file")
    parser.add_argument("--robots", type=int, default=6)
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--set", action="append", default=[], metavar="[ROBOT.]NAME=VALUE")
    chosen = parser.parse_args(arguments)
    for number in ALARMS:
        signal.signal(number, _alarm)
    try:
        app = _limited(str(Path(chosen.file).resolve()), lambda: loader.load(chosen.file))
        task = Task(app, chosen.robots, chosen.iterations, [settings.parse(one) for one in chosen.set])
        _tell(describe(task))
        for finding in examine(task):
            _tell(vars(finding))
    except Hang as hang:
        _tell({"fault": f"it hangs while it is loaded: it {hang.why}", "line": hang.line})
    except LocalError as error:
        _tell({"fault": str(error), "line": None})
    return 0


def _tell(what: Mapping[str, object]) -> None:
    sys.stdout.write(json.dumps(what) + "\n")
    sys.stdout.flush()


def describe(task: Task) -> dict[str, object]:
    """What the class declares."""
    app, kind = task.app, task.kind
    schema = kind.spec.schema
    return {
        "app": app.name,
        "class": kind.__name__,
        "kind": "sync" if issubclass(kind, SyncApp) else "periodic" if issubclass(kind, PeriodicApp) else "event",
        "algorithms": [name for name in app.algorithms if name],
        "source": app.source,
        "step_line": tracing.line_of(kind, "step" if hasattr(kind, "step") else "start"),
        "fields": {f.name: f"{f.kind}{f'[{f.length}]' if f.length > 1 else ''}" for f in schema.fields},
        "parameters": {name: declared.default for name, declared in kind.spec.parameters.items()},
        "bytes": schema.size,
        "bytes_on_air": schema.size + FRAME if schema.fields else 0,
        "channels": sorted(channels_of(kind)),
    }


def examine(task: Task) -> Iterator[_Finding]:
    """Rehearse the app on each of the standard graphs."""
    one = _sync if issubclass(task.kind, SyncApp) else _events
    for graph in GRAPHS:
        if graph != "thesis-d" or task.robots == 6:
            finding = _Finding(graph)
            try:
                one(task, finding)
            except Hang as hang:
                finding.fault, finding.line = f"it hangs: a step {hang.why}", hang.line
            except AppError as error:
                finding.fault = finding.fault or str(error)
            yield finding


# Synchronous apps


def _sync(task: Task, finding: _Finding) -> None:
    swarm = SyncRehearsal(task.app, task.scene(finding.graph))
    times: list[float] = []
    orders: set[str] = set()
    sums: set[tuple[str, int]] = set()
    may_go_on = _limit()

    def step(swarm: SyncRehearsal, name: str) -> tuple[bytes, bytes]:
        return _one_step(task.app, swarm, name, finding, times, orders, sums)

    try:
        while swarm.k < task.iterations and may_go_on():
            finding.digests.append(_digest([swarm.states[name][swarm.k] for name in swarm.names]))
            swarm.run(1, step)
    finally:
        finding.iterations = swarm.k
        if times:
            finding.step_mean, finding.step_worst = sum(times) / len(times), max(times)
    finding.trend = trends.judge({name: swarm.results[name] for name in swarm.names})
    if orders:
        finding.warnings.append(
            f"the result depends on the order of the neighbours ({min(orders)}): they always come sorted by name"
        )
    finding.warnings += [
        f"{file}, line {line}: sum() of floats may have another last bit from Python 3.12 on, math.fsum never"
        for file, line in sorted(sums)
    ]


def _one_step(
    app: loader.LoadedApp,
    swarm: SyncRehearsal,
    name: str,
    finding: _Finding,
    times: list[float],
    orders: set[str],
    sums: set[tuple[str, int]],
) -> tuple[bytes, bytes]:
    runner, k, own = swarm.runners[name], swarm.k, swarm.states[name][swarm.k]
    before, around, measured = swarm.private[name], swarm.around(name), swarm.measured(name)

    def act(neighbours: dict[str, bytes] = around) -> tuple[bytes, bytes]:
        runner.restore(k, own, before, runner.app.robot.graph)
        return runner.step(k, own, neighbours, measured)

    begin = time.process_time()
    try:
        done = _limited(app.source, act)
    except AppError as error:
        finding.fault = str(error)
        if f"{app.source}, line" not in finding.fault:
            kind = type(runner.app)
            finding.line = tracing.bad_line(runner, app.source, act) or tracing.line_of(kind, "step")
        raise
    times.append(time.process_time() - begin)
    if swarm.messages[name].used:  # messages come once: a second call sees none, and that is no fault of the step
        return done
    with tracing.float_sums() as found:
        again = _limited(app.source, act)
    sums |= found
    if again != done:
        finding.fault = f"{_where(runner, k)}: the same step gave two results: it is not a function of its inputs"
        finding.line = tracing.differing_line(runner, app.source, act) or tracing.line_of(type(runner.app), "step")
        raise AppError(finding.fault)
    if len(around) > 1 and not orders and not _near(runner, done, lambda: _reversed_step(runner, act)):
        orders.add(_where(runner, k))
    act()
    return done


def _reversed_step(runner: Runner, act: Callable[[], tuple[bytes, bytes]]) -> tuple[bytes, bytes]:
    """The step with the neighbours the other way round."""
    app = runner.app
    plain = app.step
    object.__setattr__(app, "step", lambda neighbours: plain(neighbours[::-1]))
    try:
        return act()
    finally:
        object.__delattr__(app, "step")


def _near(runner: Runner, done: tuple[bytes, bytes], other: Callable[[], tuple[bytes, bytes]]) -> bool:
    """Whether two states are the same but for the rounding of a sum in another order."""
    again = other()
    if again == done:
        return True
    numbers = [trends.numbers(runner.schema.unpack(state)) for state in (done[0], again[0])]
    scale = max((abs(x) for x in numbers[0]), default=0.0)
    return all(abs(a - b) <= 1e-6 * scale + 1e-12 for a, b in zip(*numbers, strict=True))


# Event-driven and periodic apps


def _events(task: Task, finding: _Finding) -> None:
    app = task.app
    times: list[float] = []
    histories: dict[str, list[Any]] = {}

    class Examined(EventRunner):
        def call(self, call: HandlerCall, k: int, known: Sequence[NeighbourState]) -> bytes:
            begin = time.process_time()
            try:
                own = _limited(app.source, lambda: EventRunner.call(self, call, k, known))
            except AppError as error:
                if f"{app.source}, line" not in str(error):
                    finding.line = tracing.line_of(type(self.app), call.handler)
                raise
            times.append(time.process_time() - begin)
            name = self.app.robot.name
            histories.setdefault(name, []).append(self.result())
            finding.digests.append(_digest([name.encode(), own]))
            return own

    swarm = EventRehearsal(app, task.scene(finding.graph), Examined)
    may_go_on = _limit()
    presses = [(1.0 + index, name, "abc"[index % 3]) for index, name in enumerate(swarm.units)]
    for second in range(1, int(SECONDS) + 1):
        if not may_go_on():
            break
        for at, name, button in presses:
            if at == second:
                swarm.units[name].press(button)
        swarm.run(float(second))
        for unit in swarm.units.values():
            if unit.fault:
                raise AppError(unit.fault)
    finding.iterations = max(unit.host.progress.k for unit in swarm.units.values())
    if times:
        finding.step_mean, finding.step_worst = sum(times) / len(times), max(times)
    finding.trend = trends.judge(histories)


# What both need


def _limited(source: str, act: Callable[[], T]) -> T:
    """Do it, but not for ever: `Hang` names the line of `source` that it was at."""
    _alarm.source = source  # type: ignore[attr-defined]
    signal.setitimer(signal.ITIMER_PROF, STEP_LIMIT)
    signal.setitimer(signal.ITIMER_REAL, WAIT_LIMIT)
    try:
        return act()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def _limit() -> Callable[[], bool]:
    """Tells whether a graph that begins now may go on."""
    computed, waited = time.process_time() + TIME_LIMIT, time.monotonic() + WAIT_LIMIT
    return lambda: time.process_time() < computed and time.monotonic() < waited


def _alarm(number: int, frame: FrameType | None) -> None:
    line = 1
    while frame is not None:
        if frame.f_code.co_filename == _alarm.source:  # type: ignore[attr-defined]
            line = frame.f_lineno
            break
        frame = frame.f_back
    computed = f"computed for more than {STEP_LIMIT:g} s"
    raise Hang(line, computed if number == signal.SIGPROF else f"took more than {WAIT_LIMIT:g} s")


def _where(runner: Runner, k: int) -> str:
    return f"{type(runner.app).__name__} on {runner.app.robot.name}, iteration {k}"


def _digest(states: list[bytes]) -> int:
    return zlib.crc32(b"".join(states))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
