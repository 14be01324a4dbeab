"""Pictures of apps that blink, stand and drive, from what the world saw: thesis figures 4.2 and 4.6, paths."""

import math
from bisect import bisect_left
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from laptop.plotting import style
from laptop.plotting.palette import COLOURS
from sim.core.scene_record import SceneRecord
from sim.scenario import Scenario
from sim.scene import CONTACT_M, FORMED_M, offsets_of


def draw(scenario: Scenario, scene_record: SceneRecord, began: float, path: Path) -> None:
    """Write the picture to `path`; `began`: when the run's time was 0."""
    # Slow to import and only wanted here. Agg: no display is needed.
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    match scenario.app:
        case "led_sync":
            _apart(left, scene_record, began)
            _flashes(right, scene_record, began)
        case "stand_up":
            _standing(left, scene_record, began)
            _paths(right, scenario, scene_record)
        case "formation":
            _paths(left, scenario, scene_record)
            _misfit(right, scenario, scene_record, began)
        case _:
            _paths(left, scenario, scene_record)
            _distances(right, scene_record, began)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _apart(axes: Any, scene_record: SceneRecord, began: float) -> None:
    """Each robot's flashes beside the nearest of the first one's."""
    first, farthest = scene_record.flashes[scene_record.names[0]], 0.0
    for index, name in enumerate(scene_record.names[1:] if first else (), 1):
        times = [t for t in scene_record.flashes[name] if first[0] <= t <= first[-1]]
        late = [1e3 * (t - _nearest(first, t)) for t in times]
        axes.plot([t - began for t in times], late, ".", color=_colour(index), markersize=4, label=name)
        farthest = max([farthest, *map(abs, late)])
    for limit in (-20, 20):
        axes.axhline(limit, color="0.5", linestyle=":", linewidth=1)
    axes.set(xlabel="time / s", ylabel=f"LED on after {scene_record.names[0]}'s / ms")
    if farthest > 60.0:
        axes.set_yscale("symlog", linthresh=20)
    style.legend(axes, len(scene_record.names) - 1, fontsize="small", frameon=False, handlelength=0.8)
    axes.grid(alpha=0.3)


def _flashes(axes: Any, scene_record: SceneRecord, began: float) -> None:
    """The last seconds, flash by flash."""
    ends = [times[-1] for times in scene_record.flashes.values() if times]
    if not ends:
        return
    begin = min(ends) - 3.0
    for index, name in enumerate(scene_record.names):
        times = [t - began for t in scene_record.flashes[name] if t >= begin]
        axes.plot(times, [index] * len(times), "|", color=_colour(index), markersize=24, markeredgewidth=2)
    axes.set(xlabel="time / s", title="LED on, last 3 s")
    axes.set_yticks(range(len(scene_record.names)), scene_record.names)
    axes.set_ylim(len(scene_record.names) - 0.5, -0.5)
    axes.grid(alpha=0.3)


def _standing(axes: Any, scene_record: SceneRecord, began: float) -> None:
    """Figure 4.2: who stands, over time."""
    end = max(track.end for track in scene_record.tracks.values())
    for index, name in enumerate(scene_record.names):
        at = scene_record.stood_at.get(name, end)
        height = 0.8 if name in scene_record.stood_at else 0.0
        axes.step([0.0, at - began, end - began], [-index, height - index, height - index], where="post",
                  color=_colour(index), linewidth=2)  # fmt: skip
    axes.set(xlabel="time / s", title="standing")
    axes.set_yticks([-index for index in range(len(scene_record.names))], scene_record.names)
    axes.grid(alpha=0.3)


def _paths(axes: Any, scenario: Scenario, scene_record: SceneRecord) -> None:
    for anchor in scenario.config.anchors:
        axes.plot(anchor.x, anchor.y, "^", color="0.6", markersize=7)
    for index, name in enumerate(scene_record.names):
        if places := [place for _, place in scene_record.tracks[name]]:
            axes.plot(*zip(*places, strict=True), color=_colour(index), linewidth=1.2)
            axes.plot(*places[0], "o", color=_colour(index), markerfacecolor="white", markersize=7)
            axes.plot(*places[-1], "o", color=_colour(index), markersize=9)
            axes.annotate(name, places[-1], textcoords="offset points", xytext=(7, 5), color=_colour(index))
    axes.set(xlabel="x / m", ylabel="y / m", aspect="equal", title="from white to full; triangles: anchors")
    axes.grid(alpha=0.3)


def _misfit(axes: Any, scenario: Scenario, scene_record: SceneRecord, began: float) -> None:
    found = scene_record.misfits(offsets_of(scenario))
    axes.plot([t - began for t, _ in found], [100 * misfit for _, misfit in found], color=COLOURS[0])
    axes.axhline(100 * FORMED_M, color="0.5", linestyle=":", linewidth=1)
    axes.set(xlabel="time / s", ylabel="rms distance from the shape / cm", yscale="log")
    ticks = [1, 2, 5, 10, 20, 50, 100]
    axes.set_yticks(ticks, map(str, ticks))
    axes.grid(alpha=0.3)


def _distances(axes: Any, scene_record: SceneRecord, began: float) -> None:
    """Of the nearest two at each time."""
    times = [t for t, _ in scene_record.tracks[scene_record.names[0]]]
    nearest = []
    for t in times:
        places = [place for name in scene_record.names if (place := scene_record.place(name, t)) is not None]
        pairs = [math.dist(p, q) for i, p in enumerate(places) for q in places[:i]]
        nearest.append(100 * min(pairs, default=math.nan))
    axes.plot([t - began for t in times], nearest, color=COLOURS[0])
    axes.axhline(100 * CONTACT_M, color="crimson", linestyle=":", linewidth=1.5)
    axes.set(xlabel="time / s", ylabel="nearest two / cm", ylim=(0, None))
    axes.grid(alpha=0.3)


def _colour(index: int) -> str:
    return COLOURS[index % len(COLOURS)]


def _nearest(times: Sequence[float], t: float) -> float:
    at = bisect_left(times, t)
    return min((times[i] for i in (at - 1, at) if 0 <= i < len(times)), key=lambda other: abs(other - t))
