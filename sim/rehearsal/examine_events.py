"""The examination of an event-driven or periodic app on one graph."""

from collections.abc import Sequence
from typing import Any

from services.apps.event_runner import EventRunner
from sim.rehearsal import tracing, trends
from sim.rehearsal.events import EventRehearsal
from sim.rehearsal.examine_report import GraphFinding, Task, cut_short, digest, make_all, write_line
from sim.rehearsal.limits import Stopwatch, Waits, limited
from sim.rehearsal.rehearsal import RehearsedRobot
from swarm.app.event_app import PeriodicApp
from swarm.core.asynchronous import HandlerCall, NeighbourState
from swarm.errors import AppError

SECONDS = 20.0
"""Seconds of virtual time of an event-driven or periodic app, counted from when all robots have begun."""

START_LIMIT = 10.0
"""Seconds of virtual time within which all robots must have begun."""


def examine_events(task: Task, finding: GraphFinding) -> None:
    """Run the app for `SECONDS` of virtual time, with a press of a button on each robot."""
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
                if f"{app.source}, " not in str(error):
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
            finding.digests.append(digest([name.encode(), own]))
            return own

    config = task.config(finding.graph)
    make_all(app, config)
    swarm = EventRehearsal(app, config, Examined, write_line)
    watch = Stopwatch()
    while len(began) < len(swarm.units) and swarm.now < START_LIMIT:
        swarm.run(swarm.now + 0.1)
    # Of a grid that begins now the step at the very end is the first one of the time after it.
    begin = max(began.values(), default=swarm.now)
    periods = {name: _period(unit) for name, unit in swarm.units.items()}
    end = begin + SECONDS - 1e-6
    presses, second = {1 + index: (name, "abc"[index % 3]) for index, name in enumerate(swarm.units)}, 0
    while swarm.now < end and not watch.spent:
        second += 1
        if second in presses:
            name, button = presses[second]
            swarm.units[name].press(button)
        swarm.run(min(begin + second, end))
    finding.seconds = round(swarm.now - begin, 3)
    finding.iterations = min(unit.host.progress.k for unit in swarm.units.values())
    finding.note([unit.app for unit in swarm.units.values()], times)
    finding.trend = trends.judge(histories)
    if swarm.now < end:
        cut_short(finding, watch, f"{finding.seconds:g} of {SECONDS:g} s")
        return
    for name, unit in swarm.units.items():
        period, progress = periods[name], unit.host.progress
        promised = 0 if period is None or _period(unit) != period else round(SECONDS / period)
        if progress.k < promised and progress.phase != "done":
            why = f"; it waits for {', '.join(progress.waiting_for)}" if progress.waiting_for else ""
            raise AppError(f"{name} did {progress.k} of the {promised} steps that {SECONDS:g} s have{why}")


def _period(unit: RehearsedRobot) -> float | None:
    """Return the seconds between two steps of a robot's app; None where it has no steps."""
    runner = unit.host.runner
    assert isinstance(runner, EventRunner)
    return runner.period
