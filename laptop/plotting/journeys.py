"""Floods, and messages from one robot to another, on their way through the swarm (thesis figures 3.13 to 3.16)."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from laptop.plotting import style
from swarm.errors import LocalError
from swarm.recording.run import Run

PANELS = 6
"""The most floods or messages that are shown. They are the last ones."""

CLOCKS = 0.01
"""Seconds by which the clocks of two robots may differ. So a message may seem to arrive before it has left."""

OUT, BACK = style.COLOURS[0], style.COLOURS[1]


def floods(figure: Any, run: Run) -> None:
    """Draw each flood from its start: when it reached each robot, and when its origin knew that it was complete
    (thesis figures 3.13 and 3.14)."""
    requests = [it for it in _requests(run) if not it.to]
    answers, heard = _answers(run), _heard(run)
    arrivals = _arrivals(requests, answers, heard)
    panels, some = _panels(figure, run, requests, "flood")
    for axes, request in panels:
        which = request.origin, request.ticket
        _flood(axes, request, answers.get(which), arrivals[which], list(run.robots))
    figure.suptitle(f"bar: until its origin knows; dot: it has arrived{some}", fontsize=9)


def unicasts(figure: Any, run: Run) -> None:
    """Draw each message from one robot to another: its path and that of its answer, robot by robot, and when its
    sender knew (thesis figure 3.16)."""
    requests = [it for it in _requests(run) if it.to]
    answers, heard, passes = _answers(run), _heard(run), _passes(run)
    arrivals = _arrivals(requests, answers, heard)
    panels, some = _panels(figure, run, requests, "message")
    for axes, request in panels:
        answer = answers.get((request.origin, request.ticket))
        arrived = min((t for t, _ in arrivals[request.origin, request.ticket]), default=None)
        known = answer[0] if answer is not None and answer[1]["delivered"] else None
        told = _of(request, passes, answer[0] if answer is not None else math.inf)
        way = legs(told, request.origin, request.to, arrived, known)
        _message(axes, request, answer, arrived, way, list(run.robots))
    figure.suptitle(
        f"blue: the message, ring: it is there; red: its answer; bar: until its sender knows{some}\n"
        "dot: handed on; x: the next robot has not seen it",
        fontsize=9,
    )


class Pass(NamedTuple):
    """A report that a robot hands a message, or the answer to it, to a neighbour."""

    t: float
    robot: str
    next: str
    back: bool


class JourneyLeg(NamedTuple):
    """The path of a message over one link."""

    t: float
    robot: str
    next: str
    back: bool
    until: float | None
    """The time of arrival; None if no arrival was recorded."""


def legs(passes: Iterable[Pass], sender: str, to: str, arrived: float | None, known: float | None) -> list[JourneyLeg]:
    """Return the way of one message from `sender` to `to`, and of its answers, by what the robots on it have told.

    A robot hands on at once what comes to it, so that tells when it came: each arrival belongs to what was last handed
    to that robot before. `arrived`: when the receiver's app got it; `known`: when the sender got the answer.
    """
    ordered = sorted(passes)
    # The receiver answers each copy that comes to it.
    arrivals = [(it.t, it.robot, it.back and it.robot != to) for it in ordered]
    if arrived is not None and not any(it.back and it.robot == to for it in ordered):
        arrivals.append((arrived, to, False))
    if known is not None:
        arrivals.append((known, sender, True))
    until: dict[int, float] = {}
    for t, robot, back in sorted(arrivals):
        before = [
            index
            for index, it in enumerate(ordered)
            if it.next == robot and it.back == back and it.t <= t + CLOCKS and index not in until
        ]
        if before:
            until[before[-1]] = t
    # The sender heeds the first answer alone, and tells nothing of others.
    heeded = min((ordered[index].t for index in until if ordered[index].next == sender), default=math.inf)
    return [
        JourneyLeg(*it, until.get(index))
        for index, it in enumerate(ordered)
        if index in until or not (it.back and it.next == sender and it.t >= heeded)
    ]


class _Request(NamedTuple):
    t: float
    origin: str
    ticket: str
    to: str
    size: int


class _Passed(NamedTuple):
    ticket: str
    message: tuple[str, str, int]
    """Sender, receiver and number."""
    it: Pass


_Answer = tuple[float, dict[str, Any]]
_Heard = tuple[float, str, dict[str, Any]]


def _requests(run: Run) -> list[_Request]:
    found: dict[tuple[str, str], _Request] = {}
    for sample in run.samples(f"swarm/*/app/{run.app or '*'}/asked"):
        it, origin = sample.message, sample.topic.split("/")[1]
        found.setdefault((origin, it["ticket"]), _Request(sample.t, origin, it["ticket"], it["to"], it["size"]))
    return list(found.values())


def _answers(run: Run) -> dict[tuple[str, str], _Answer]:
    """Return by robot and ticket when the answer was known, and what it is."""
    found: dict[tuple[str, str], _Answer] = {}
    for sample in run.samples("swarm/*/mesh/flooded", "swarm/*/mesh/sent"):
        found.setdefault((sample.topic.split("/")[1], sample.message["ticket"]), (sample.t, sample.message))
    return found


def _heard(run: Run) -> list[_Heard]:
    return [
        (sample.t, sample.topic.split("/")[1], sample.message)
        for sample in run.samples(f"swarm/*/app/{run.app or '*'}/heard")
    ]


def _passes(run: Run) -> list[_Passed]:
    found = []
    for sample in run.samples("swarm/*/mesh/passed"):
        it = sample.message
        step = Pass(sample.t, sample.topic.split("/")[1], it["next"], it["back"])
        found.append(_Passed(it["ticket"], (it["sender"], it["to"], it["number"]), step))
    return found


def _of(request: _Request, passes: Sequence[_Passed], until: float) -> list[Pass]:
    """Return the reports on one request's message. A mesh that is started again counts its numbers anew."""
    message = next(
        (each.message for each in passes if (each.it.robot, each.ticket) == (request.origin, request.ticket)), None
    )
    return [it for _, told, it in passes if told == message and request.t - CLOCKS <= it.t <= until + CLOCKS]


def _panels(figure: Any, run: Run, requests: Sequence[_Request], what: str) -> tuple[list[tuple[Any, _Request]], str]:
    """Make axes for the last requests. Return these pairs, and text that tells how many of all they are, empty where
    they are all."""
    if not requests:
        raise LocalError(f"no app has sent a {what} in this recording")
    shown = requests[-PANELS:]
    columns = 1 if len(shown) == 1 else 2
    rows = math.ceil(len(shown) / columns)
    figure.set_size_inches(max(5.0, 3.7 * columns), rows * (1.1 + 0.24 * len(run.robots)))
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for axes in panels.flat[len(shown) :]:
        axes.set_visible(False)
    some = f" (the last {len(shown)} of {len(requests)})" if len(shown) < len(requests) else ""
    return list(zip(panels.flat, shown, strict=False)), some


def _arrivals(
    requests: Sequence[_Request], answers: Mapping[tuple[str, str], _Answer], heard: Sequence[_Heard]
) -> dict[tuple[str, str], list[tuple[float, str]]]:
    """Return by origin and ticket when a request's payload came to which robot. An arrival has no ticket: it belongs to
    the first request of its size that was under way then, and has not come to that robot before."""
    found: dict[tuple[str, str], list[tuple[float, str]]] = {(it.origin, it.ticket): [] for it in requests}
    ends = {(it.origin, it.ticket): _end(it, requests, answers) for it in requests}
    for t, robot, message in heard:
        candidates = [
            it
            for it in requests
            if it.origin == message["sender"]
            and message["flooded"] == (not it.to)
            and it.to in ("", robot)
            and it.size == message["size"]
            and it.t <= t + CLOCKS
            and all(robot != other for _, other in found[it.origin, it.ticket])
        ]
        under_way = [it for it in candidates if t <= ends[it.origin, it.ticket] + CLOCKS]
        if candidates:
            it = under_way[0] if under_way else candidates[-1]
            found[it.origin, it.ticket].append((t, robot))
    return found


def _end(request: _Request, requests: Sequence[_Request], answers: Mapping[tuple[str, str], _Answer]) -> float:
    """Return when a request's answer was known, or where there is none when its origin made the next request."""
    if (answer := answers.get((request.origin, request.ticket))) is not None:
        return answer[0]
    later = [it.t for it in requests if (it.origin, it.to) == (request.origin, request.to) and it.t > request.t]
    return min(later, default=math.inf)


def _flood(
    axes: Any, request: _Request, answer: _Answer | None, arrivals: list[tuple[float, str]], robots: list[str]
) -> None:
    """Draw one flood's panel."""
    row = robots.index(request.origin)
    last = max((1e3 * (t - request.t) for t, _ in arrivals), default=1.0)
    outcome = "no answer"
    if answer is not None:
        took = 1e3 * (answer[0] - request.t)
        last = max(last, took)
        axes.barh(row, took, height=0.5, color=OUT, alpha=0.85)
        _say(axes, took, row, OUT)
        outcome = "complete" if answer[1]["complete"] else "not " + answer[1].get("problem", "")
    for t, robot in arrivals:
        at, after = robots.index(robot), 1e3 * (t - request.t)
        axes.plot((0, after), (at, at), color="0.8", linewidth=1, zorder=1)
        axes.plot(after, at, "o", color=BACK, markersize=5)
    _finish(axes, request, robots, last, f"from {request.origin} to {len(arrivals)} robots: {outcome}")


def _message(
    axes: Any,
    request: _Request,
    answer: _Answer | None,
    arrived: float | None,
    way: Sequence[JourneyLeg],
    robots: list[str],
) -> None:
    """Draw one message's panel: its path from row to row."""

    def after(t: float) -> float:
        return 1e3 * (t - request.t)

    row = {name: index for index, name in enumerate(robots)}
    times = [it.until or it.t for it in way] + [t for t in (arrived, answer and answer[0]) if t is not None]
    last = max(map(after, times), default=1.0)
    outcome = "no answer"
    if answer is not None:
        took = after(answer[0])
        axes.plot((0, took), (row[request.origin],) * 2, color="0.85", linewidth=5, solid_capstyle="butt", zorder=1)
        _say(axes, took, row[request.origin], BACK)
        outcome = "delivered" if answer[1]["delivered"] else answer[1].get("problem", "not delivered")
    for it in way:
        colour = BACK if it.back else OUT
        begin, end = row[it.robot], row.get(it.next, row[it.robot])
        axes.plot(after(it.t), begin, "o", color=colour, markersize=4, zorder=3)
        if it.until is not None:
            axes.plot((after(it.t), after(it.until)), (begin, end), color=colour, linewidth=1.6, zorder=2)
        else:  # a stub towards where it was to go
            x, y = after(it.t) + 0.03 * last, begin + 0.35 * (end > begin) - 0.35 * (end < begin)
            axes.plot((after(it.t), x), (begin, y), color=colour, linewidth=1.6, zorder=2)
            axes.plot(x, y, "x", color=colour, markersize=5, zorder=3)
    if arrived is not None:
        axes.plot(after(arrived), row[request.to], "o", color=OUT, fillstyle="none", markersize=9, zorder=4)
        _say(axes, after(arrived), row[request.to], OUT, below=10)  # the answer's line begins here
    _finish(axes, request, robots, last, f"{request.origin} to {request.to}: {outcome}")


def _say(axes: Any, after: float, row: int, colour: str, below: float = 0.0) -> None:
    axes.annotate(
        f"{after:.0f} ms",
        (after, row),
        xytext=(7, -below),
        textcoords="offset points",
        va="center",
        fontsize=7.5,
        color=colour,
    )


def _finish(axes: Any, request: _Request, robots: list[str], last: float, title: str) -> None:
    style.rows_of_robots(axes, robots)
    axes.set_ylim(len(robots) - 0.1, -0.6)  # room for a label below the last row
    axes.set(xlim=(-0.02 * last, 1.18 * last), title=f"at {request.t:.1f} s, {request.size} B {title}")
    axes.set_xlabel("time since it was sent / ms")
