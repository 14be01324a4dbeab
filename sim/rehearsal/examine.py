"""The examination of an app for `swarm check`, in a process of its own, since the app may hang, or hash differently.

    python -m sim.rehearsal.examine FILE --robots 6 --iterations 300

It prints one JSON object a line: what the app declares, then what came of each graph.
"""

import argparse
import json
import os
import signal
import sys
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from services.apps import loader
from services.apps.event_runner import EventRunner
from services.apps.runner import Runner
from sim.rehearsal import tracing, trends
from sim.rehearsal.events import EventRehearsal
from sim.rehearsal.limits import ALARMS, Hang, Stopwatch, Waits, alarm, limited
from sim.rehearsal.scene import rehearsal_config
from sim.rehearsal.sync import ITERATION_S, SyncRehearsal
from sim.scenario import imports
from swarm.app import settings
from swarm.app.event_app import PeriodicApp, channels_of
from swarm.app.settings import Setting
from swarm.app.sync_app import BaseApp as AnyApp
from swarm.app.sync_app import SyncApp
from swarm.config import Config
from swarm.core.asynchronous import HandlerCall, NeighbourState
from swarm.errors import AppError, LocalError
from swarm.frozen import frozen
from swarm.messages import Measurement
from swarm.messages.codec import Value

GRAPHS = ("line", "loop", "thesis-d", "full", "random:1")
"""Standard graphs; thesis-d is one of six robots."""

SECONDS = 20.0
"""Seconds of virtual time of an event-driven or periodic app, counted from when all robots have begun."""

START_LIMIT = 10.0
"""Seconds of virtual time within which all robots must have begun."""

YES, NO, UNASKED = "yes", "no", "not asked for"
"""Words for whether the app has had poses, or ranges, in the rehearsal."""

FRAME = 18
"""Bytes that mesh and lockstep add to a state on an authenticated link (docs/reference/network/frames.md)."""


@frozen
class Task:
    """The app to examine, and how."""

    app: loader.LoadedApp
    robots: int = 6
    iterations: int = 300
    settings: Sequence[Setting] = ()

    @property
    def kind(self) -> type[AnyApp]:
        """Return the class that runs."""
        chosen = {one.name: one.value for one in self.settings if one.name == "algorithm"}
        return self.app.choose(chosen)[0]

    def config(self, graph: str) -> Config:
        """Return the configuration of the swarm on one graph."""
        return rehearsal_config(self.app, self.robots, graph, *settings.common_and_single(self.settings))


@dataclass
class _Finding:
    """The findings on one graph."""

    graph: str
    fault: str = ""
    line: int | None = None
    warnings: list[str] = field(default_factory=list)
    seconds: float = 0.0
    """Seconds of virtual time that the app was given."""
    last: bool = False
    """Whether the app hangs or mostly waits: each other graph would take as long again to say the same."""
    iterations: int = 0
    """Steps of the robot that has done the fewest; events, where the app has no steps."""
    poses: str = UNASKED
    ranges: str = UNASKED
    step_mean: float = 0.0
    """Mean CPU time of a step on this machine, s."""
    trend: dict[str, object] = field(default_factory=dict)
    """See `trends.judge`."""
    digests: list[int] = field(default_factory=list)
    """Checksum of all robots' states, by iteration: must be the same in another process."""


def main(arguments: list[str], out: TextIO) -> int:
    """Examine one app; findings go to `out`, a line each."""
    parser = argparse.ArgumentParser(prog="python -m sim.rehearsal.examine")
    parser.add_argument("file")
    parser.add_argument("--robots", type=int, default=6)
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--set", action="append", default=[], metavar="[ROBOT.]NAME=VALUE")
    chosen = parser.parse_args(arguments)
    for number in ALARMS:
        signal.signal(number, alarm)
    try:
        app = limited(str(Path(chosen.file).resolve()), lambda: loader.load(chosen.file))
        task = Task(app, chosen.robots, chosen.iterations, [settings.parse(one) for one in chosen.set])
        _tell(out, describe(task))
        for finding in examine(task):
            _tell(out, vars(finding))
    except Hang as hang:
        _tell(out, {"fault": f"it hangs while it is loaded: it {hang.why}", "line": hang.line})
    except LocalError as error:
        _tell(out, {"fault": str(error), "line": None})
    return 0


def _tell(out: TextIO, what: Mapping[str, object]) -> None:
    out.write(json.dumps(what) + "\n")
    out.flush()


def describe(task: Task) -> dict[str, object]:
    """Return the declarations of the class."""
    app, kind = task.app, task.kind
    schema = kind.spec.schema
    return {
        "app": app.name,
        "class": kind.__name__,
        "kind": "sync" if issubclass(kind, SyncApp) else "periodic" if issubclass(kind, PeriodicApp) else "event",
        "algorithms": [name for name in app.algorithms if name],
        "source": app.source,
        "step_line": tracing.line_of(kind, "step" if hasattr(kind, "step") else "start"),
        "fields": {f.name: f"{f.kind}{list(f.shape) or ''}" for f in schema.fields},
        "parameters": {name: declared.default for name, declared in kind.spec.parameters.items()},
        "bytes": schema.size,
        "bytes_on_air": schema.size + FRAME if schema.fields else 0,
        "channels": sorted(channels_of(kind)),
        "warnings": [] if app.name in loader.BUILT_IN else imports.missing_imports(app.source, imports.own_packages()),
    }


def examine(task: Task) -> Iterator[_Finding]:
    """Rehearse the app on each of the standard graphs. The first on which it hangs or mostly waits is the last one."""
    one = _sync if issubclass(task.kind, SyncApp) else _events
    for graph in GRAPHS:
        if graph != "thesis-d" or task.robots == 6:
            finding = _Finding(graph)
            try:
                one(task, finding)
            except Hang as hang:
                finding.fault, finding.line, finding.last = f"it hangs: a step {hang.why}", hang.line, True
            except AppError as error:
                finding.fault = finding.fault or str(error)
            yield finding
            if finding.last:
                return


def _make_all(app: loader.LoadedApp, config: Config) -> None:
    """Make the app of each robot, none of them for ever."""
    app.check(config, lambda config, name: limited(app.source, partial(app.make, config, name)))


# Synchronous apps


def _sync(task: Task, finding: _Finding) -> None:
    source = task.app.source

    class Examined(Runner):
        def start(self, measurement: Measurement | None) -> tuple[bytes, bytes]:
            return limited(source, lambda: Runner.start(self, measurement))

        def result(self) -> dict[str, Value]:
            return limited(source, lambda: Runner.result(self))

    config = task.config(finding.graph)
    _make_all(task.app, config)
    swarm = SyncRehearsal(task.app, config, runner=Examined)
    times: list[float] = []
    orders: set[str] = set()
    sums: set[tuple[str, int]] = set()
    watch = Stopwatch()

    def step(swarm: SyncRehearsal, name: str) -> tuple[bytes, bytes]:
        return _one_step(task.app, swarm, name, finding, times, orders, sums)

    try:
        while swarm.k < task.iterations and not watch.spent:
            finding.digests.append(_digest([swarm.states[name][swarm.k] for name in swarm.names]))
            swarm.run(1, step)
    finally:
        finding.seconds, finding.iterations = ITERATION_S * swarm.k, swarm.k
        finding.poses, finding.ranges = _had([runner.app for runner in swarm.runners.values()])
        if times:
            finding.step_mean = sum(times) / len(times)
    if swarm.k < task.iterations:
        _cut_short(finding, watch, f"{swarm.k} of {task.iterations} iterations")
    finding.trend = trends.judge({name: swarm.results[name] for name in swarm.names})
    if orders:
        finding.warnings.append(
            f"the result depends on the order of the neighbours ({min(orders)}): they always come sorted by name"
        )
    finding.warnings += [
        f"{file}, line {line}: sum() rounds floats differently from Python 3.12 on; use math.fsum"
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

    watch = Stopwatch()
    try:
        done = limited(app.source, act)
    except AppError as error:
        finding.fault = str(error)
        if f"{app.source}, line" not in finding.fault:
            kind = type(runner.app)
            finding.line = tracing.bad_line(runner, app.source, act) or tracing.line_of(kind, "step")
        raise
    times.append(watch.computed)
    if swarm.messages[name].used:  # messages come once: a second call sees none, and that is no fault of the step
        return done
    with tracing.float_sums() as found:
        again = limited(app.source, act)
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
    """Do the step with the neighbours in reverse order."""
    app = runner.app
    plain = app.step
    object.__setattr__(app, "step", lambda neighbours: plain(neighbours[::-1]))
    try:
        return act()
    finally:
        object.__delattr__(app, "step")


def _near(runner: Runner, done: tuple[bytes, bytes], other: Callable[[], tuple[bytes, bytes]]) -> bool:
    """Return whether two states are the same but for the rounding of a sum in another order."""
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
    began: dict[str, float] = {}
    waits = Waits()
    first = "step" if issubclass(task.kind, PeriodicApp) else "start"

    class Examined(EventRunner):
        def call(self, call: HandlerCall, k: int, known: Sequence[NeighbourState]) -> bytes:
            watch = Stopwatch()
            try:
                own = limited(app.source, lambda: EventRunner.call(self, call, k, known))
            except AppError as error:
                if f"{app.source}, line" not in str(error):
                    finding.line = tracing.line_of(type(self.app), call.handler)
                raise
            times.append(watch.computed)
            name = self.app.robot.name
            if call.handler == "step" and (fault := waits.judge(name, watch.waited, self.period)):
                finding.line, finding.last = tracing.line_of(type(self.app), "step"), True
                raise AppError(fault)
            if call.handler == first:
                began.setdefault(name, self.app.robot.now)
            histories.setdefault(name, []).append(limited(app.source, self.result))
            finding.digests.append(_digest([name.encode(), own]))
            return own

    config = task.config(finding.graph)
    _make_all(app, config)
    swarm = EventRehearsal(app, config, Examined)
    watch = Stopwatch()
    while len(began) < len(swarm.units) and swarm.now < START_LIMIT:
        _pass(swarm, swarm.now + 0.1)
    # Of a grid that begins now the step at the very end is the first one of the time after it.
    begin, periods = max(began.values(), default=swarm.now), _periods(swarm)
    end = begin + SECONDS - 1e-6
    presses, second = {1 + index: (name, "abc"[index % 3]) for index, name in enumerate(swarm.units)}, 0
    while swarm.now < end and not watch.spent:
        second += 1
        if second in presses:
            name, button = presses[second]
            swarm.units[name].press(button)
        _pass(swarm, min(begin + second, end))
    finding.seconds = round(swarm.now - begin, 3)
    finding.iterations = min(unit.host.progress.k for unit in swarm.units.values())
    finding.poses, finding.ranges = _had([unit.app for unit in swarm.units.values()])
    if times:
        finding.step_mean = sum(times) / len(times)
    finding.trend = trends.judge(histories)
    if swarm.now < end:
        _cut_short(finding, watch, f"{finding.seconds:g} of {SECONDS:g} s")
        return
    for name, unit in swarm.units.items():
        period, progress = periods[name], unit.host.progress
        promised = 0 if period is None or unit.host.runner.period != period else round(SECONDS / period)
        if progress.k < promised and progress.phase != "done":
            why = f"; it waits for {', '.join(progress.waiting_for)}" if progress.waiting_for else ""
            raise AppError(f"{name} did {progress.k} of the {promised} steps that {SECONDS:g} s have{why}")


def _pass(swarm: EventRehearsal, until: float) -> None:
    """Let time pass. Raises `AppError` where an app has failed."""
    swarm.run(until)
    for unit in swarm.units.values():
        if unit.fault:
            raise AppError(unit.fault)


def _periods(swarm: EventRehearsal) -> dict[str, float | None]:
    return {name: unit.host.runner.period for name, unit in swarm.units.items()}


# What both need


def _had(apps: Sequence[AnyApp]) -> tuple[str, str]:
    """Return whether robots that asked for poses, and for ranges, have some."""
    poses, ranges = [], []
    for app in apps:
        devices, ranging = app.robot.devices, app.robot.ranging
        if devices is not None and devices.asked("pose"):
            poses.append(devices.pose is not None)
        if ranging is not None and ranging.listening:
            ranges.append(bool(ranging.ranges))
        if getattr(type(app), "measured", False):
            ranges.append(app.robot.measurement is not None)
    return _said(poses), _said(ranges)


def _said(there: Sequence[bool]) -> str:
    return UNASKED if not there else YES if all(there) else NO


def _cut_short(finding: _Finding, watch: Stopwatch, done: str) -> None:
    finding.last = watch.waited > watch.computed
    rest = f" ({watch.waited:.2g} s of it waiting); no other graph is tried" if finding.last else ""
    finding.warnings.append(f"graph {finding.graph}: broken off after {watch.spent}: {done}{rest}")


def _where(runner: Runner, k: int) -> str:
    return f"{type(runner.app).__name__} on {runner.app.robot.name}, iteration {k}"


def _digest(states: list[bytes]) -> int:
    return zlib.crc32(b"".join(states))


if __name__ == "__main__":
    # What the app prints, with or without an end of its line, goes elsewhere than the findings.
    with os.fdopen(os.dup(1), "w") as findings:
        os.dup2(2, 1)
        sys.exit(main(sys.argv[1:], findings))
