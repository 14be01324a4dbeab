"""What happened when: flashes of LEDs, floods and messages on their way, robots that stand up."""

import math
from bisect import bisect_left
from collections import Counter
from itertools import pairwise
from typing import Any, NamedTuple

from swarm.errors import LocalError
from swarm.plotting import style
from swarm.recording.run import Run

PANELS = 6
"""Floods or messages shown, the last ones."""
PERIODS = 8
"""Flashes shown in the panel of LEDs."""
STANDING = "balancing"
"""The balancer's mode when a robot stands."""


def leds(figure: Any, run: Run) -> None:
    """Who flashes when: the end of the run in detail, and each flash against the first robot's, over the whole run."""
    flashes, lit = _flashes(run)
    robots = [name for name in run.robots if flashes.get(name)]
    if not robots:
        raise LocalError(f"{run.path}: no LED has been switched in this recording")
    figure.set_size_inches(7.0, 2.2 + 0.28 * len(robots) + 2.2)
    grid = figure.add_gridspec(2, 1, height_ratios=(0.6 + 0.28 * len(robots), 2.6))
    top, bottom = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    first = flashes[robots[0]]
    periods = [b - a for a, b in pairwise(first)]
    period = sorted(periods)[len(periods) // 2] if periods else 1.0
    end = max(times[-1] for times in flashes.values())
    begin = end - PERIODS * period
    for index, name in enumerate(robots):
        colour = style.colour(index, len(robots))
        for on, off in lit[name]:
            if off >= begin and on <= end + period / 2:
                top.barh(index, off - on, left=on, height=0.62, color=colour)
        offsets = [(t, 1e3 * _nearest(first, t)) for t in flashes[name]]
        bottom.plot(*zip(*offsets, strict=True), "." if len(offsets) > 60 else style.mark(index), color=colour,
                    markersize=3.2, label=name)  # fmt: skip
    style.rows_of_robots(top, robots)
    top.set(xlabel="time / s", xlim=(begin, end + period / 2), title="LED on, the last flashes")
    bottom.set(
        xlabel="time / s",
        ylabel=f"flash after that of {robots[0]} / ms",
    )
    style.legend(bottom, len(robots))


def floods(figure: Any, run: Run) -> None:
    """Each flood from its start: when it reached whom, and when its origin knew that it was complete (thesis figures
    3.13 and 3.14)."""
    _journeys(figure, run, [it for it in _requests(run) if not it.to], "flood")


def unicasts(figure: Any, run: Run) -> None:
    """Each message from one robot to another: when it arrived, and when its sender knew (thesis figure 3.16)."""
    _journeys(figure, run, [it for it in _requests(run) if it.to], "message")


def standup(figure: Any, run: Run) -> None:
    """When each robot stands, and its tilt meanwhile (thesis figure 4.2).

    The moment is the app's own word where it has one: the body's state is recorded five times a second only."""
    said = {
        robot: sample.t
        for sample in reversed([s for s in run.samples("swarm/*/app/*/record/standing") if s.message["value"]])
        if (robot := sample.topic.split("/")[1])
    }
    tilts: dict[str, list[tuple[float, float, bool]]] = {}
    for sample in run.samples("swarm/*/balancer/state"):
        message = sample.message
        tilts.setdefault(sample.topic.split("/")[1], []).append(
            (sample.t, math.degrees(message["tilt"]), message["mode"] == STANDING)
        )
    robots = [name for name in run.robots if name in tilts]
    if not robots:
        raise LocalError(f"{run.path}: no state of a balancer is recorded")
    figure.set_size_inches(6.4, 1.0 + 0.55 * len(robots))
    axes = figure.add_subplot()
    for index, name in enumerate(robots):
        colour = style.colour(index, len(robots))
        times, degrees, stands = zip(*tilts[name], strict=True)
        axes.fill_between(times, index + 0.4, index - 0.4, where=stands, step="post", color=colour, alpha=0.22,
                          linewidth=0)  # fmt: skip
        axes.plot(times, [index - 0.38 * value / 110 for value in degrees], color=colour, linewidth=1.1)
        up = next((t for t, stood in zip(times, stands, strict=True) if stood), None)
        up = said.get(name, up)
        if up is not None and up > times[0]:
            axes.annotate(f"{up:.1f} s", (up, index), textcoords="offset points", xytext=(3, 5), fontsize=7.5,
                          color=colour)  # fmt: skip
    style.rows_of_robots(axes, robots)
    axes.set(xlabel="time / s", title="line: tilt (a row is ±110°), filled: it stands")


class _Request(NamedTuple):
    t: float
    origin: str
    ticket: str
    to: str
    size: int


def _requests(run: Run) -> list[_Request]:
    found = []
    for sample in run.samples("swarm/*/app/*/asked"):
        message = sample.message
        origin = sample.topic.split("/")[1]
        found.append(_Request(sample.t, origin, message["ticket"], message["to"], message["size"]))
    return found


def _journeys(figure: Any, run: Run, requests: list[_Request], what: str) -> None:
    if not requests:
        raise LocalError(f"{run.path}: no app has sent a {what} in this recording")
    answers: dict[tuple[str, str], tuple[float, dict[str, Any]]] = {}
    for sample in run.samples("swarm/*/mesh/flooded", "swarm/*/mesh/sent"):
        message = sample.message
        answers.setdefault((sample.topic.split("/")[1], message["ticket"]), (sample.t, message))
    heard = [(sample.t, sample.topic.split("/")[1], sample.message) for sample in run.samples("swarm/*/app/*/heard")]
    shown = requests[-PANELS:]
    robots = list(run.robots)
    columns = 1 if len(shown) == 1 else 2
    rows = math.ceil(len(shown) / columns)
    figure.set_size_inches(max(5.0, 3.7 * columns), rows * (1.1 + 0.24 * len(robots)))
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for axes in panels.flat[len(shown) :]:
        axes.set_visible(False)
    for axes, request in zip(panels.flat, shown, strict=False):
        _journey(
            axes, request, answers.get((request.origin, request.ticket)), _arrivals(request, requests, heard), robots
        )
    some = f" (the last {len(shown)} of {len(requests)})" if len(shown) < len(requests) else ""
    figure.suptitle(f"bar: until its sender knows; dot: it has arrived{some}", fontsize=9)


def _arrivals(
    request: _Request, requests: list[_Request], heard: list[tuple[float, str, dict[str, Any]]]
) -> list[tuple[float, str]]:
    """When a request's payload came to whom: what came from its origin before that one's next request."""
    later = [it.t for it in requests if it.origin == request.origin and it.t > request.t]
    until = min(later, default=math.inf)
    return [
        (t, robot)
        for t, robot, message in heard
        if message["sender"] == request.origin
        and message["flooded"] == (not request.to)
        and request.t <= t < until
        and request.to in ("", robot)
    ]


def _journey(
    axes: Any,
    request: _Request,
    answer: tuple[float, dict[str, Any]] | None,
    arrivals: list[tuple[float, str]],
    robots: list[str],
) -> None:
    """One request's panel."""
    row = robots.index(request.origin)
    last = max((1e3 * (t - request.t) for t, _ in arrivals), default=1.0)
    outcome = "no answer"
    if answer is not None:
        took = 1e3 * (answer[0] - request.t)
        last = max(last, took)
        axes.barh(row, took, height=0.5, color=style.COLOURS[0], alpha=0.85)
        axes.annotate(f" {took:.0f} ms", (took, row), va="center", fontsize=7.5, color=style.COLOURS[0])
        done = answer[1].get("complete", answer[1].get("delivered"))
        outcome = ("complete" if not request.to else "delivered") if done else "not " + answer[1].get("problem", "")
    for t, robot in arrivals:
        at, after = robots.index(robot), 1e3 * (t - request.t)
        axes.plot((0, after), (at, at), color="0.8", linewidth=1, zorder=1)
        axes.plot(after, at, "o", color=style.COLOURS[1], markersize=5)
    style.rows_of_robots(axes, robots)
    way = f"{request.origin} to {request.to}" if request.to else f"from {request.origin} to {len(arrivals)} robots"
    axes.set(xlim=(0, 1.16 * last), title=f"at {request.t:.1f} s, {request.size} B {way}: {outcome}")
    axes.set_xlabel("time since it was sent / ms")


def _flashes(run: Run) -> tuple[dict[str, list[float]], dict[str, list[tuple[float, float]]]]:
    """Times at which each robot's flashing LED came on, and the stretches it was on: by the registers of the simulated
    robots, or what the balancer says. The LED is the one that was switched most often."""
    topic = "sim/leds" if any(name.endswith("/sim/leds") for name in run.topics) else "balancer/leds"
    changes: Counter[str] = Counter()
    states: dict[str, list[tuple[float, dict[str, Any]]]] = {}
    for sample in run.samples(f"swarm/*/{topic}"):
        message = sample.message
        before = states.setdefault(sample.topic.split("/")[1], [])
        if before:
            changes.update(led for led in ("red", "yellow", "green") if message[led] != before[-1][1][led])
        before.append((sample.t, message))
    led = max(("red", "yellow", "green"), key=lambda name: changes[name])
    flashes: dict[str, list[float]] = {}
    lit: dict[str, list[tuple[float, float]]] = {}
    for robot, entries in states.items():
        on: float | None = None
        for t, message in entries:
            if message[led] and on is None:
                on = t
                flashes.setdefault(robot, []).append(t)
            elif not message[led] and on is not None:
                lit.setdefault(robot, []).append((on, t))
                on = None
        lit.setdefault(robot, [])
    return (flashes if changes[led] else {}), lit


def _nearest(times: list[float], t: float) -> float:
    """How much later t is than the nearest of the times."""
    index = bisect_left(times, t)
    return min((t - other for other in times[max(0, index - 1) : index + 1]), key=abs)
