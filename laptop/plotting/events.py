"""Pictures of events over time: flashes of LEDs, robots that stand up."""

import math
from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from laptop.plotting import style
from swarm.errors import LocalError
from swarm.recording.axis import MESH_CLOCK
from swarm.recording.run import Run

PERIODS = 8
"""Number of flashes that the panel of LEDs shows."""
NEAR_MS, FAR_MS = 20.0, 60.0
"""If differences between flashes exceed FAR_MS, their scale is linear up to NEAR_MS and logarithmic beyond."""
SILENT_S = 1.0
"""Time without a state of the body after which its robot counts as switched off, s: five are recorded in a second."""
STANDING = "balancing"
"""The balancer's mode when a robot stands."""


def leds(figure: Any, run: Run) -> None:
    """Draw the flashes of robots: the end of the run in detail, and each flash relative to those of the first robot
    that flashes to the end, over the whole run. Where no two robots flash, LEDs are drawn over the whole run. Nobody
    knows when the LEDs of real robots shone in truth: the picture says whose word and which clock it shows."""
    flashes, lit, source = _flashes(run)
    robots = [name for name in run.robots if flashes.get(name)]
    if not robots:
        raise LocalError("no LED has been switched in this recording")
    if sum(len(flashes[name]) > 1 for name in robots) < 2:
        figure.set_size_inches(7.0, 1.6 + 0.28 * len(robots))
        axes = figure.add_subplot()
        _draw_lit(axes, robots, lit)
        axes.set(xlim=(0.0, None), title="LED on")
        style.say_below(figure, f"{source}, by the time of {run.basis}")
        return
    figure.set_size_inches(7.0, 2.2 + 0.28 * len(robots) + 2.2)
    grid = figure.add_gridspec(2, 1, height_ratios=(0.6 + 0.28 * len(robots), 2.6))
    top, bottom = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    periods = sorted(b - a for times in flashes.values() for a, b in pairwise(times))
    period = periods[len(periods) // 2] if periods else 1.0
    end = max(times[-1] for times in flashes.values())
    first = next(name for name in robots if flashes[name][-1] > end - 2 * period)  # it has not stopped
    begin = max(0.0, end - PERIODS * period)
    farthest = 0.0
    for index, name in enumerate(robots):
        colour = style.colour(index, len(robots))
        apart = [(t, _nearest(flashes[first], t)) for t in flashes[name]]
        # Half a period is the most while the first robot flashes.
        offsets = [(t, 1e3 * offset) for t, offset in apart if abs(offset) < 0.75 * period]
        farthest = max([farthest, *(abs(offset) for _, offset in offsets)])
        bottom.plot(
            [t for t, _ in offsets],
            [offset for _, offset in offsets],
            "." if len(offsets) > 60 else style.mark(index),
            color=colour,
            markersize=3.2,
            label=name,
        )
    shown = {name: [(on, off) for on, off in lit[name] if off >= begin and on <= end + period / 2] for name in robots}
    _draw_lit(top, robots, shown)
    top.set(xlim=(begin, end + period / 2), title="LED on, the last flashes")
    bottom.set(
        xlabel=style.TIME,
        ylabel=f"flash after that of {first} / ms",
    )
    if farthest > FAR_MS:  # before the robots flash together; afterwards milliseconds are to be seen
        bottom.set_yscale("symlog", linthresh=NEAR_MS, linscale=2.0)
        far = [10.0**power for power in range(2, 5) if 10.0**power < 3 * farthest]
        ticks = [*(-tick for tick in far), -NEAR_MS, -NEAR_MS / 2, 0.0, NEAR_MS / 2, NEAR_MS, *far]
        bottom.set_yticks(sorted(ticks), [f"{tick:g}" for tick in sorted(ticks)])
        bottom.minorticks_off()
    style.legend(bottom, len(robots))
    doubt = " (the LEDs follow it too: its errors are not to be seen)" if run.basis == MESH_CLOCK else ""
    style.say_below(figure, f"{source}, by the time of {run.basis}{doubt}")


def _draw_lit(axes: Any, robots: Sequence[str], lit: Mapping[str, Sequence[tuple[float, float]]]) -> None:
    """Draw a row for each robot, with a bar for each stretch in which its LED was on."""
    for index, name in enumerate(robots):
        for on, off in lit[name]:
            axes.barh(index, off - on, left=on, height=0.62, color=style.colour(index, len(robots)))
    style.rows_of_robots(axes, robots)
    axes.set(xlabel=style.TIME)


def standup(figure: Any, run: Run) -> None:
    """Draw when each robot stands, and its tilt meanwhile (thesis figure 4.2).

    The moment is the app's own word where it has one: the body's state is recorded five times a second only.
    """
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
        raise LocalError(f"no state of a balancer is recorded{style.DEVICES}")
    figure.set_size_inches(6.4, 1.0 + 0.55 * len(robots))
    axes = figure.add_subplot()
    for index, name in enumerate(robots):
        colour = style.colour(index, len(robots))
        times, degrees, stands = zip(*_with_silence(tilts[name]), strict=True)
        axes.fill_between(
            times, index + 0.4, index - 0.4, where=stands, step="post", color=colour, alpha=0.22, linewidth=0
        )
        axes.plot(times, [index - 0.38 * value / 110 for value in degrees], color=colour, linewidth=1.1)
        up = next((t for t, stood in zip(times, stands, strict=True) if stood), None)
        up = said.get(name, up)
        if up is not None and up > times[0]:
            axes.annotate(
                f"{up:.1f} s", (up, index), textcoords="offset points", xytext=(3, 5), fontsize=7.5, color=colour
            )
    style.rows_of_robots(axes, robots)
    axes.set(xlabel=style.TIME, title="line: tilt (a row is ±110°), filled: it stands")


def _with_silence(tilts: list[tuple[float, float, bool]]) -> list[tuple[float, float, bool]]:
    """Insert an unknown state before each silence, so that a line has a gap there."""
    found = tilts[:1]
    for entry in tilts[1:]:
        if entry[0] - found[-1][0] > SILENT_S:
            found.append((found[-1][0], math.nan, False))
        found.append(entry)
    return found


def _flashes(run: Run) -> tuple[dict[str, list[float]], dict[str, list[tuple[float, float]]], str]:
    """Return the times at which each robot's flashing LED came on, the stretches it was on, at most to the last state
    of an app, and who says so: the registers of the simulated robots, or the balancers. The LED is the one that was
    switched most often."""
    simulated = any(name.endswith("/sim/leds") for name in run.topics)
    topic = "sim/leds" if simulated else "balancer/leds"
    changes: Counter[str] = Counter()
    states: dict[str, list[tuple[float, dict[str, Any]]]] = {}
    for sample in run.samples(f"swarm/*/{topic}"):
        message = sample.message
        before = states.setdefault(sample.topic.split("/")[1], [])
        if before:
            changes.update(led for led in ("red", "yellow", "green") if message[led] != before[-1][1][led])
        before.append((sample.t, message))
    led = max(("red", "yellow", "green"), key=lambda name: changes[name])
    last = max(
        (path.newest for channel in run.states() for path in run.trajectories(channel=channel).values()), default=0
    )
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
        if on is not None and on < last:
            lit[robot].append((on, last))
    source = "registers of the simulated LEDs" if simulated else "LEDs as the balancers report them"
    return (flashes if changes[led] else {}), lit, source


def _nearest(times: list[float], t: float) -> float:
    """Return how much later t is than the nearest of the times."""
    index = bisect_left(times, t)
    return min((t - other for other in times[max(0, index - 1) : index + 1]), key=abs)
