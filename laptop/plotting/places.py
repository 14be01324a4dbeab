"""The map of a run: robots, their paths, their estimates of the target, and the uncertainty of these."""

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

from laptop.plotting import style
from services.apps.core import formation
from sim.core.contacts import TOUCH_M
from swarm.config import Config
from swarm.errors import LocalError
from swarm.recording.folder import config_in
from swarm.recording.run import Run

Place = tuple[float, float]

Spread = tuple[float, float, float]
"""Variance of x, covariance, variance of y, m^2; NaN where they are not known."""

PLACED = ("swarm/*/dwm/pose", "swarm/*/sim/truth", "swarm/*/app/*/measurement")
"""Topics with the places of robots, the best one first."""

MOVING = ("formation", "goto")
"""Built-in apps whose picture shows how near robots come to each other."""

SIGMAS = 2.0
"""Half-axes of the ellipses in standard deviations. They contain 86 % of a plane's normal distribution."""


class _Estimate(NamedTuple):
    """One robot's estimate of the target."""

    k: int
    t: float
    place: Place
    spread: Spread


def draw_map(figure: Any, run: Run, references: Mapping[str, Sequence[Place]] | None = None) -> None:
    """Draw anchors, robots, their paths, and where they think that the target is, with ellipses of two standard
    deviations. Of simulated robots, draw the true paths, too. Where the target's place is known, the estimates' errors
    over iterations stand beside the map, and the errors of the `references` (by robot, from iteration 0 on) are dotted.
    Of apps that drive, how near robots came stands there, and how far they were from their formation."""
    swarm = config_in(run.path)
    way, estimates = _target(run, swarm), _estimates(run)
    robots = list(run.robots)
    truths = paths(run, ("swarm/*/sim/truth",))
    moves = truths if run.built_in in MOVING and len(truths) > 1 else {}
    panels = 2 if (way and estimates) or moves else 1
    figure.set_size_inches(5.2 * panels, 4.8)
    axes = figure.add_subplot(1, panels, 1)
    if way and estimates:
        _errors(figure.add_subplot(1, 2, 2), way, estimates, robots, references or {})
    elif moves:
        distances(figure.add_subplot(1, 2, 2), run, {name: moves[name] for name in robots if name in moves})
    marks: set[str] = set()
    still: list[Place] = [] if swarm is None else [(anchor.x, anchor.y) for anchor in swarm.anchors]
    for place in still:
        axes.plot(*place, "^", color=style.GREY, markersize=8, **_once(marks, "anchor"))
    seen = list(still)
    if way:
        seen += [place for _, place in way]
        still.append(way[-1][1])
        if len(way) > 1:
            axes.plot(
                *zip(*(place for _, place in way), strict=True),
                "-",
                color="black",
                linewidth=1.4,
                zorder=4,
                **_once(marks, "target's way"),
            )
        axes.plot(*way[-1][1], "*", color="black", markersize=13, zorder=5, **_once(marks, "target"))
    tracks = paths(run)
    names: list[tuple[str, Place, Any]] = []
    for index, name in enumerate(robots):
        colour = style.colour(index, len(robots))
        if name in tracks:
            if name in truths and f"swarm/{name}/dwm/pose" in run.topics:
                axes.plot(
                    *zip(*(place for place, _ in truths[name]), strict=True),
                    ":",
                    color="black",
                    linewidth=0.8,
                    zorder=3,
                    **_once(marks, "true path"),
                )
            _path(axes, tracks[name], colour, marks)
            names.append((name, tracks[name][-1][0], colour))
            seen += [place for place, _ in tracks[name]]
        if track := estimates.get(name):
            axes.plot(*zip(*(it.place for it in track), strict=True), "-", color=colour, linewidth=0.7, alpha=0.6)
            _, t, place, spread = track[-1]
            if len(way) > 1:  # the target goes on after the last estimate
                there = _at(way, t)
                axes.plot(*zip(place, there, strict=True), ":", color=colour, linewidth=0.9, zorder=5)
                axes.plot(
                    *there, ".", color=colour, markersize=5, zorder=6, **_once(marks, "where the target was then")
                )
            axes.plot(
                *place, "x", color=colour, markersize=7, markeredgewidth=1.6, zorder=6, **_once(marks, "estimate")
            )
            _ellipse(axes, place, spread, colour, marks)
            seen += [it.place for it in track[len(track) // 4 :]]
    if not seen:
        raise LocalError("no place is recorded: neither poses nor a target")
    frame(axes, seen)
    axes.set(xlabel="x / m", ylabel="y / m", aspect="equal")
    # Below the label of the axis, however high the picture is: distances in lines of text.
    legend = axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), borderaxespad=4.0, ncols=3)
    style.name_points(axes, names, still, [place for name, _, _ in names for place, _ in tracks[name][::3]])
    for handle in legend.legend_handles:
        handle.set_color("black" if handle.get_label().startswith(("target", "true")) else style.GREY)


def _once(marks: set[str], label: str) -> dict[str, str]:
    """Return a label for the legend the first time only."""
    if label in marks:
        return {}
    marks.add(label)
    return {"label": label}


def paths(run: Run, topics: Sequence[str] = PLACED) -> dict[str, list[tuple[Place, dict[str, Any]]]]:
    """Return each robot's places by the first of the topics that has them: its poses, else the simulation's truth,
    else what its app measured."""
    found: dict[str, list[tuple[Place, dict[str, Any]]]] = {}
    for topic in topics:
        fresh: dict[str, list[tuple[Place, dict[str, Any]]]] = {}
        for sample in run.samples(topic):
            message = sample.message | {"t": sample.t}
            if message.get("quality", 1) > 0:
                fresh.setdefault(sample.topic.split("/")[1], []).append(((message["x"], message["y"]), message))
        found = {**fresh, **found}
    return found


def _target(run: Run, swarm: Config | None) -> list[tuple[float, Place]]:
    """Return the places of the simulated target over time; of real robots they are unknown."""
    if swarm is None or _seeker(run) is None:
        return []
    topics = sorted(topic for topic in run.topics if topic.endswith("/sim/target"))
    if topics:  # all robots have the same
        return [(sample.t, (sample.message["x"], sample.message["y"])) for sample in run.samples(topics[0])]
    simulated = any(topic.endswith("/sim/truth") for topic in run.topics)
    return [(0.0, swarm.simulation.target)] if simulated else []


def _seeker(run: Run) -> str | None:
    """Return the name of the app that looks for a target: localization, or an app that gets ranges to it."""
    measured = {topic.split("/")[3] for topic in run.topics if topic.endswith("/measurement") and "/app/" in topic}
    return next((app for app in run.apps if app == "localization" or app in measured), None)


def _at(way: Sequence[tuple[float, Place]], t: float) -> Place:
    """Return the place on a way at time t, on the line between two samples."""
    index = bisect_left(way, t, key=itemgetter(0))
    if index in (0, len(way)):
        return way[min(index, len(way) - 1)][1]
    (before, (xa, ya)), (after, (xb, yb)) = way[index - 1], way[index]
    share = (t - before) / (after - before)
    return xa + share * (xb - xa), ya + share * (yb - ya)


def _estimates(run: Run) -> dict[str, list[_Estimate]]:
    """Return each robot's estimates of the target, with variances and covariance where it tells them."""
    found: dict[str, list[_Estimate]] = {}
    app = _seeker(run)
    for name, path in run.trajectories(app).items() if app is not None else ():
        x, y = ("result.x", "result.y") if "result.x" in path.columns else ("x", "y")
        if {x, y} - set(path.columns):
            continue
        spread = ("result.var_x", "result.cov_xy", "result.var_y")
        track: list[_Estimate] = []
        for k in sorted(path.rows):
            place = path.value(k, x), path.value(k, y)
            if all(map(math.isfinite, place)):
                xx, xy, yy = (path.value(k, column) if column in path.columns else math.nan for column in spread)
                track.append(_Estimate(k, path.times[k], place, (xx, xy, yy)))
        if track:
            found[name] = track
    return found


def _errors(
    axes: Any,
    way: Sequence[tuple[float, Place]],
    estimates: Mapping[str, list[_Estimate]],
    robots: list[str],
    references: Mapping[str, Sequence[Place]],
) -> None:
    """Draw the distance of each robot's estimates from the target."""
    for index, name in enumerate(robots):
        track = estimates.get(name, ())
        errors = [100 * math.dist(it.place, _at(way, it.t)) for it in track]
        colour = style.colour(index, len(robots))
        axes.plot([it.k for it in track], errors, color=colour, linewidth=1.0)
        if track and name in references:
            recorded = [100 * math.dist(place, _at(way, track[0].t)) for place in references[name]]
            axes.plot(recorded, ":", color=colour, linewidth=1.6, label="recorded" if not index else None)
    if references:
        axes.legend(loc="upper right")
    axes.set(xlabel="iteration", ylabel="distance to the true target / cm", yscale="log")


def distances(axes: Any, run: Run, tracks: Mapping[str, list[tuple[Place, dict[str, Any]]]]) -> None:
    """Draw over time the distance of the two robots that are nearest to each other. Of a formation, draw how far the
    robots are from it (root mean square, wherever it stands)."""
    import numpy as np

    times = {name: np.array([message["t"] for _, message in track]) for name, track in tracks.items()}
    grid = np.arange(max(each[0] for each in times.values()), min(each[-1] for each in times.values()), 0.2)
    places = np.array(
        [
            [np.interp(grid, times[name], [place[axis] for place, _ in track]) for axis in (0, 1)]
            for name, track in tracks.items()
        ]
    )
    pairs = [np.hypot(*(places[i] - places[j])) for i in range(len(places)) for j in range(i)]
    axes.plot(grid, np.min(pairs, axis=0), color=style.COLOURS[0], label="nearest two")
    axes.axhline(TOUCH_M, color=style.GREY, linewidth=0.8, linestyle="--", label="robots touch")
    if run.built_in == "formation":
        told = [sample.message["parameters"] for sample in run.samples("swarm/*/app/formation/parameters")]
        shape, size = (told[0][name]["value"] if told else None for name in ("shape", "size"))
        robots = list(tracks)
        offsets = np.array(
            [
                formation.offset(shape or formation.SHAPES[0], i, len(robots), size or formation.SIZE)
                for i in range(len(robots))
            ]
        )
        apart = places - offsets[:, :, None]
        apart -= apart.mean(axis=0)
        misfit = np.sqrt((apart**2).sum(axis=1).mean(axis=0))
        axes.plot(grid, misfit, color=style.COLOURS[1], label="from the formation")
    axes.set(xlabel=style.TIME, ylabel="distance / m", ylim=(0, None))
    style.legend(axes, 3)


def _path(axes: Any, path: list[tuple[Place, dict[str, Any]]], colour: Any, marks: set[str]) -> None:
    xs, ys = zip(*(place for place, _ in path), strict=True)
    axes.plot(xs, ys, "-", color=colour, linewidth=1.0, alpha=0.9, **_once(marks, "path"))
    place, last = path[-1]
    axes.plot(*place, "o", color=colour, markersize=7, zorder=4, **_once(marks, "robot"))
    if (heading := last.get("heading")) is not None:
        axes.annotate(
            "",
            (place[0] + 0.12 * math.cos(heading), place[1] + 0.12 * math.sin(heading)),
            place,
            arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 1.2},
        )
    if (dx := last.get("deviation_x")) is not None and (dy := last.get("deviation_y")) is not None:
        _ellipse(axes, place, (dx * dx, last.get("correlation", 0.0) * dx * dy, dy * dy), colour, marks)


def _ellipse(axes: Any, place: Place, spread: Spread, colour: Any, marks: set[str]) -> None:
    """Draw an ellipse of two standard deviations, from variances and covariance."""
    if not all(map(math.isfinite, spread)):
        return
    from matplotlib.patches import Ellipse

    xx, xy, yy = spread
    middle, radius = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    width, height = (2 * SIGMAS * math.sqrt(max(0.0, middle + sign * radius)) for sign in (1, -1))
    angle = math.degrees(0.5 * math.atan2(2 * xy, xx - yy))
    axes.add_patch(Ellipse(place, width, height, angle=angle, facecolor=colour, alpha=0.18, linewidth=0, zorder=2))
    axes.add_patch(Ellipse(place, width, height, angle=angle, fill=False, edgecolor=colour, linewidth=0.9, zorder=3))
    if label := _once(marks, f"{SIGMAS:g} standard deviations"):
        axes.plot([], [], "o", fillstyle="none", markersize=10, **label)  # a patch would have a box in the legend


def frame(axes: Any, places: list[Place]) -> None:
    """Set the limits of the axes to all places and a margin."""
    xs, ys = zip(*places, strict=True)
    margin = 0.08 * max(max(xs) - min(xs), max(ys) - min(ys), 0.5) + 0.1
    axes.set(xlim=(min(xs) - margin, max(xs) + margin), ylim=(min(ys) - margin, max(ys) + margin))
