"""What apps computed: states over iterations and over time, iterations over time."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from laptop.plotting import style
from swarm.errors import LocalError
from swarm.recording.run import Run
from swarm.recording.trajectory import Trajectory

DOTS = 120
"""Iterations up to which each has a dot."""
PANELS = 6
"""Columns shown at most, where none are asked for."""


def states(figure: Any, run: Run, columns: Sequence[str] = (), labels: Mapping[str, str] | None = None) -> None:
    """A row of two panels for each column: over iterations and over time. Truth values get one panel, over time.

    `columns`: names as in the app, or with the channel before them (`frequency.value`); default: what is shared.
    `labels`: what stands at the axis of a column, with its unit; default: its name.
    """
    panels = [(label, column, paths) for label, column, paths in _columns(run) if not columns or label in columns]
    if not panels:
        known = ", ".join(label for label, _, _ in _columns(run)) or "none"
        raise LocalError(f"{run.path}: no such column of states; there are: {known}")
    if not columns:
        panels = [panel for panel in panels if not panel[1].startswith("result.")][:PANELS] or panels[:PANELS]
    figure.set_size_inches(7.2, max(2.9, 2.3 * len(panels)))
    grid = figure.add_gridspec(len(panels), 2)
    for row, (label, column, paths) in enumerate(panels):
        title = (labels or {}).get(label, label)
        if _is_truth(column, paths):
            _truth(figure.add_subplot(grid[row, :]), title, column, paths)
            continue
        left = figure.add_subplot(grid[row, 0])
        right = figure.add_subplot(grid[row, 1], sharey=left)
        for index, (name, path) in enumerate(paths.items()):
            ks = sorted(path.rows)
            values = [path.value(k, column) for k in ks]
            look = _look(index, len(paths), len(ks))
            left.plot(ks, values, label=name, **look)
            right.plot([path.times[k] for k in ks], values, **look)
        left.set(xlabel="iteration", ylabel=title)
        right.set(xlabel="time / s")
        style.whole(left.xaxis)
        right.tick_params(labelleft=False)
        if row == 0:
            style.legend(left, len(paths))


def iterations(figure: Any, run: Run) -> None:
    """Iteration over time, for each robot (thesis figures 3.9 and 3.11)."""
    channels = [(name, run.trajectories(channel=name)) for name in run.states()]
    channels = [(name, paths) for name, paths in channels if any(len(path.rows) > 1 for path in paths.values())]
    if not channels:
        raise LocalError(f"{run.path}: no app's iterations are recorded")
    figure.set_size_inches(5.2, 3.1 * len(channels))
    for panel, (channel, paths) in enumerate(channels):
        axes = figure.add_subplot(len(channels), 1, panel + 1)
        for index, (name, path) in enumerate(paths.items()):
            ks = sorted(path.times)
            look = _look(index, len(paths), len(ks)) | {"drawstyle": "steps-post"}
            axes.plot([path.times[k] for k in ks], ks, label=f"{name}: {_pace(path)}", **look)
        axes.set(xlabel="time / s", ylabel=f"iteration of {channel}" if channel else "iteration")
        style.whole(axes.yaxis)
        style.legend(axes, len(paths), loc="center left", bbox_to_anchor=(1.0, 0.5), ncols=1, title="mean period")


def _columns(run: Run) -> list[tuple[str, str, dict[str, Trajectory]]]:
    """Label, column and trajectories of all that can be drawn: a vector's parts one by one."""
    found = []
    for channel in run.states():
        paths = {name: path for name, path in run.trajectories(channel=channel).items() if path.rows}
        for column in next(iter(paths.values())).columns if paths else ():
            if any(_is_number(path, column) for path in paths.values()):
                found.append((f"{channel}.{column}" if channel else column, column, paths))
    return found


def _is_number(path: Trajectory, column: str) -> bool:
    index = path.columns.index(column)
    return any(_number(row[index]) for row in path.rows.values())


def _number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return text in ("True", "False")


def _is_truth(column: str, paths: Mapping[str, Trajectory]) -> bool:
    path = next(iter(paths.values()))
    index = path.columns.index(column)
    return all(row[index] in ("True", "False") for row in path.rows.values())


def _truth(axes: Any, label: str, column: str, paths: Mapping[str, Trajectory]) -> None:
    """A row for each robot, filled while it is true."""
    end = max((t for path in paths.values() for t in path.times.values()), default=0.0)
    for index, path in enumerate(paths.values()):
        at = path.columns.index(column)
        ks = sorted(path.rows)
        times = [path.times[k] for k in ks] + [end]
        values = [path.rows[k][at] == "True" for k in ks]
        values.append(values[-1])
        colour = style.colour(index, len(paths))
        axes.fill_between(
            times,
            index + 0.32,
            [index + 0.32 - 0.64 * value for value in values],
            step="post",
            color=colour,
            alpha=0.85,
            linewidth=0,
        )
        axes.plot(
            times, [index + 0.32 - 0.64 * value for value in values], drawstyle="steps-post", color=colour, linewidth=1
        )
    style.rows_of_robots(axes, list(paths))
    axes.set(xlabel="time / s", title=f"{label}: filled = true")


def _look(index: int, robots: int, points: int) -> dict[str, Any]:
    dots = points <= DOTS and robots <= style.FEW
    return {
        "color": style.colour(index, robots),
        "linewidth": 1.1 if robots <= style.FEW else 0.6,
        "marker": style.mark(index) if dots else "",
        "markersize": 2.6,
    }


def _pace(path: Trajectory) -> str:
    """Mean time of an iteration."""
    ks = sorted(path.times)
    if len(ks) < 3:
        return "-"
    seconds = (path.times[ks[-1]] - path.times[ks[1]]) / (ks[-1] - ks[1])
    return f"{1e3 * seconds:.3g} ms" if seconds < 1 else f"{seconds:.3g} s"
