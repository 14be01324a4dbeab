"""Pictures of what apps computed: states over iterations and over time, iterations over time."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from laptop.plotting import style
from sim.report import is_metric
from swarm.errors import LocalError
from swarm.recording.reader import MEMBERS, PLOTTED
from swarm.recording.run import Run
from swarm.recording.trajectory import Trajectory

_Panel = tuple[str, str, dict[str, Trajectory], tuple[str, ...]]
"""Label, column, the robots' trajectories, and the names that stand at 0, 1, ... where values have names."""

DOTS = 120
"""The most iterations that are drawn with a dot each."""
STEPS: dict[str, Any] = {"drawstyle": "steps-post"}
AWAY_S = 0.5
"""Least time without an iteration that is drawn as a gap in a line, s."""
STOPS: dict[str, Any] = {"marker": "x", "linestyle": "", "markersize": 5}
GOES_ON: dict[str, Any] = {"marker": "o", "linestyle": "", "markersize": 5, "fillstyle": "none"}
"""The marks at the ends of a gap in a line: over iterations the ends are side by side."""
MOST_NAMES = 12
"""The most different texts of a column that is drawn: an enum has few members."""
PANELS = 6
"""The most columns that are shown if none are requested."""


def states(
    figure: Any,
    run: Run,
    columns: Sequence[str] = (),
    labels: Mapping[str, str] | None = None,
    between: Sequence[float] | None = None,
) -> None:
    """Draw a row of two panels for each column: over iterations and over time. Truth values get one panel, over time.
    Members of an enum, and other texts of which there are few, are steps with their names at the axis.

    `columns`: names as in the app, or with the channel before them (`frequency.value`); default: what is shared.
    `labels`: what stands at the axis of a column, with its unit; default: its name. `between`: two times of the run, s;
    only the iterations between them are shown.
    """
    every = _columns(run)
    if columns:  # in the order in which they are asked for
        panels = [panel for name in columns for panel in _named(run, name, every)]
    elif every:
        once = _once(every)
        panels = _marked(run, once) or _chosen(once)
        _say_left_out(figure, run, every, panels[PANELS:])
        panels = panels[:PANELS]
    else:
        raise LocalError("no column of states can be drawn")
    labels = labels or {}
    names = [panel[0].removeprefix("result.") for panel in panels]
    if unused := labels.keys() - {panel[0] for panel in panels} - set(names):
        raise LocalError(f"label of {min(unused)!r}: no such column is drawn; drawn are: {_listed(names)}")
    figure.set_size_inches(7.2, max(2.9, 2.3 * len(panels)))
    grid = figure.add_gridspec(len(panels), 2)
    for row, (label, column, paths, members) in enumerate(panels):
        plain = label.removeprefix("result.")
        title = labels.get(label, labels.get(plain, plain))
        if _is_truth(column, paths):
            _truth(figure.add_subplot(grid[row, :]), title, column, paths)
            continue
        left = figure.add_subplot(grid[row, 0])
        right = figure.add_subplot(grid[row, 1], sharey=left)
        whole = bool(members) or all(_is_whole(path, column) for path in paths.values() if path.rows)
        held = whole or any(path.held for path in paths.values())
        most = max(len(path.rows) for path in paths.values())
        for index, (name, path) in enumerate(paths.items()):
            look = _look(index, len(paths), most)
            left.plot(*_line(path, column, leaps(path)), label=name, **look, **(STEPS if whole else {}))
            ks, values = _line(path, column, gaps(path))
            right.plot([path.times[k] for k in ks], values, **look, **(STEPS if held else {}))
        for index, path in enumerate(paths.values()):
            _mark_gaps(left, right, path, column, style.colour(index, len(paths)))
        left.set(xlabel="iteration", ylabel=title)
        right.set(xlabel=style.TIME)
        style.integer_ticks(left.xaxis)
        if between is not None:
            begin, end = between
            if ks := [k for path in paths.values() for k, t in path.times.items() if begin <= t <= end]:
                left.set_xlim(min(ks), max(*ks, min(ks) + 1))
        if members:
            left.set_yticks(range(len(members)), members)
        elif whole:
            style.integer_ticks(left.yaxis)
        right.tick_params(labelleft=False)
        if row == 0:
            style.legend(left, len(paths))
            if any(map(gaps, paths.values())):
                right.plot([], [], label="stops", color="black", **STOPS)
                right.plot([], [], label="goes on", color="black", **GOES_ON)
                style.legend(right, 2)


def _named(run: Run, name: str, panels: Sequence[_Panel]) -> list[_Panel]:
    """Return the panels of a column: a vector has one name or one for each entry. A result needs no `result.` before
    its name unless a shared state has the same. Raises `LocalError` where there is none."""
    plain = [(panel[0].replace("result.", ""), panel) for panel in panels]
    for known in ([(panel[0], panel) for panel in panels], plain):
        if found := [panel for label, panel in known if name in (label, label.partition("[")[0])]:
            return found
    there = ", ".join(dict.fromkeys(label for label, _ in plain)) or "none"
    raise LocalError(f"no such column of states; there are: {there}; got {name!r}")


def _marked(run: Run, panels: Sequence[_Panel]) -> list[_Panel]:
    """Return the panels that the author's `plotted` names, in that order: a vector or an entry of it."""
    return [panel for name in _plotted(run) for panel in panels if _is_named(panel, name)]


def _once(panels: Sequence[_Panel]) -> list[_Panel]:
    """Return the panels without results that repeat a shared state under its name."""
    shared = {panel[0] for panel in panels if not _is_result(panel)}
    return [panel for panel in panels if not _is_result(panel) or panel[0].replace("result.", "", 1) not in shared]


def _is_result(panel: _Panel) -> bool:
    return panel[1].startswith("result.")


def _plotted(run: Run) -> list[str]:
    """Return the names in the author's `plotted`. Each robot's file has them."""
    return list(dict.fromkeys(name for notes in run.notes(PLOTTED) for name in notes.get(run.app, "").split()))


def _is_named(panel: _Panel, name: str) -> bool:
    column = panel[1].removeprefix("result.")
    return name in (column, column.partition("[")[0])


def _say_left_out(figure: Any, run: Run, panels: Sequence[_Panel], beyond: Sequence[_Panel]) -> None:
    """Write below the picture which columns are beyond its panels, and which names in `plotted` are none of `panels`,
    those that can be drawn."""
    unknown = [name for name in _plotted(run) if not any(_is_named(panel, name) for panel in panels)]
    notes = [f"`plotted` names what cannot be drawn: {_listed(unknown)}"] if unknown else []
    if beyond:
        names = _listed([panel[0].removeprefix("result.") for panel in beyond])
        notes.append(f"not shown, as {PANELS} rows are the most: {names} (ask for them by name)")
    if notes:
        style.say_below(figure, *notes)


def _listed(names: Sequence[str]) -> str:
    more = [f"and {len(names) - PANELS} more"] if len(names) > PANELS else []
    return ", ".join([*names[:PANELS], *more])


def _chosen(panels: Sequence[_Panel]) -> list[_Panel]:
    """Return the panels in their order where none is named: errors, single values, then vectors entry by entry, those
    of results first."""
    return sorted(panels, key=lambda panel: (not is_metric(panel[1]), "[" in panel[1] and 2 - _is_result(panel)))


def iterations(figure: Any, run: Run) -> None:
    """Draw iterations over time, for each robot (thesis figures 3.9 and 3.11)."""
    channels = [(name, run.trajectories(channel=name)) for name in run.states()]
    channels = [(name, paths) for name, paths in channels if any(len(path.rows) > 1 for path in paths.values())]
    if not channels:
        raise LocalError("no app's iterations are recorded")
    figure.set_size_inches(5.2, 3.1 * len(channels))
    for panel, (channel, paths) in enumerate(channels):
        axes = figure.add_subplot(len(channels), 1, panel + 1)
        most = max(len(path.times) for path in paths.values())
        for index, (name, path) in enumerate(paths.items()):
            look = _look(index, len(paths), most) | {"drawstyle": "steps-post"}
            ks = _with_gaps(sorted(path.times), gaps(path))
            times = [path.times[k] for k in ks]
            drawn = [math.nan if again else k for k, again in zip(ks, _again(ks), strict=True)]
            axes.plot(times, drawn, label=f"{name}: {_pace(path)}", **look)
        axes.set(xlabel=style.TIME, ylabel=f"iteration of {channel}" if channel else "iteration")
        style.integer_ticks(axes.yaxis)
        style.legend(axes, len(paths), loc="center left", bbox_to_anchor=(1.0, 0.5), ncols=1, title="mean period")


def leaps(path: Trajectory) -> tuple[int, ...]:
    """Return each k before which a robot was away: it began anew there, was started again or had lost its state, or
    others went on without it and its k leaps."""
    ks = sorted(path.rows)
    steps = [after - k for k, after in itertools.pairwise(ks)]
    usual = sorted(steps)[len(steps) // 2] if steps else 0
    far = {after for step, after in zip(steps, ks[1:], strict=True) if step > 10 * usual}
    return tuple(sorted({*path.breaks, *path.returns, *path.restarts, *far}))


def gaps(path: Trajectory) -> tuple[int, ...]:
    """Return each k before which a robot was away: `leaps`, or it did nothing for `AWAY_S` where it has a pace."""
    ks = sorted(path.rows)
    steps = [path.times[after] - path.times[k] for k, after in itertools.pairwise(ks)]
    ordered = sorted(steps)
    paced = len(steps) >= 10 and ordered[len(steps) * 9 // 10] <= 3 * ordered[len(steps) // 2]
    long = max(AWAY_S, 10 * ordered[len(steps) // 2]) if paced else math.inf
    pauses = [after for step, after in zip(steps, ks[1:], strict=True) if step > long]
    return tuple(sorted({*leaps(path), *pauses}))


def _mark_gaps(left: Any, right: Any, path: Trajectory, column: str, colour: Any) -> None:
    """Mark the ends of a robot's gaps: over time all of them, over iterations those in which it was away."""
    ends, away = set(gaps(path)), leaps(path)
    for before, after in itertools.pairwise(sorted(path.rows)):
        if after not in ends:
            continue
        for k, mark in ((before, STOPS), (after, GOES_ON)):
            right.plot([path.times[k]], [path.value(k, column)], color=colour, **mark)
            if after in away:
                left.plot([k], [path.value(k, column)], color=colour, **mark)


def _line(path: Trajectory, column: str, breaks: Sequence[int]) -> tuple[list[int], list[float]]:
    """Return iterations and values, nan where the line has a gap."""
    ks = _with_gaps(sorted(path.rows), breaks)
    return ks, [math.nan if again else path.value(k, column) for k, again in zip(ks, _again(ks), strict=True)]


def _with_gaps(ks: Sequence[int], breaks: Sequence[int]) -> list[int]:
    """Return the iterations, with the last one before each gap twice."""
    found: list[int] = []
    for k in ks:
        if k in breaks and found:
            found.append(found[-1])
        found.append(k)
    return found


def _again(ks: Sequence[int]) -> list[bool]:
    return [index > 0 and ks[index - 1] == k for index, k in enumerate(ks)]


def _columns(run: Run) -> list[_Panel]:
    """Return label, column and trajectories of all that can be drawn: a vector's parts one by one."""
    found: list[_Panel] = []
    declared = {name: text.split() for notes in run.notes(MEMBERS) for name, text in notes.items()}
    for channel in run.states():
        paths = {name: path for name, path in run.trajectories(channel=channel).items() if path.rows}
        for column in next(iter(paths.values())).columns if paths else ():
            label = f"{channel}.{column}" if channel else column
            if any(_is_number(path, column) for path in paths.values()):
                found.append((label, column, paths, ()))
            elif 0 < len(members := _members(paths, column, declared.get(f"{run.app}.{label}", ()))) <= MOST_NAMES:
                found.append((label, column, _numbered(paths, column, members), members))
    return found


def _members(paths: Mapping[str, Trajectory], column: str, declared: Sequence[str]) -> tuple[str, ...]:
    """Return the texts in a column: of an enum in the order in which its members are `declared`, so that pictures of
    two runs can be compared, others in the order in which they come."""
    cells = [(k, row[path.columns.index(column)]) for path in paths.values() for k, row in path.rows.items()]
    there = dict.fromkeys(text for _, text in sorted(cells, key=lambda cell: cell[0]) if text)
    return tuple(sorted(there, key=declared.index)) if there.keys() <= set(declared) else tuple(there)


def _numbered(paths: Mapping[str, Trajectory], column: str, members: Sequence[str]) -> dict[str, Trajectory]:
    """Return the trajectories with the texts of a column replaced by their places in `members`."""
    numbers = {text: str(index) for index, text in enumerate(members)}
    found = {}
    for robot, path in paths.items():
        at = path.columns.index(column)
        rows = {k: (*row[:at], numbers.get(row[at], ""), *row[at + 1 :]) for k, row in path.rows.items()}
        found[robot] = replace(path, rows=rows)
    return found


def _is_number(path: Trajectory, column: str) -> bool:
    index = path.columns.index(column)
    return any(_number(row[index]) for row in path.rows.values())


def _number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return text in ("True", "False")


def _is_whole(path: Trajectory, column: str) -> bool:
    """Return whether it counts: between two iterations there is nothing to be drawn as a slope."""
    index = path.columns.index(column)
    return all(row[index].lstrip("-").isdigit() for row in path.rows.values())


def _is_truth(column: str, paths: Mapping[str, Trajectory]) -> bool:
    path = next(iter(paths.values()))
    index = path.columns.index(column)
    return all(row[index] in ("True", "False") for row in path.rows.values())


def _truth(axes: Any, label: str, column: str, paths: Mapping[str, Trajectory]) -> None:
    """Draw a row for each robot, filled while its value is true."""
    end = max((t for path in paths.values() for t in path.times.values()), default=0.0)
    for index, path in enumerate(paths.values()):
        at = path.columns.index(column)
        ks = _with_gaps(sorted(path.rows), gaps(path))
        times = [path.times[k] for k in ks] + [end]
        bottom = index + 0.32
        tops = [
            math.nan if again else bottom - 0.64 * (path.rows[k][at] == "True")
            for k, again in zip(ks, _again(ks), strict=True)
        ]
        tops.append(tops[-1])
        colour = style.colour(index, len(paths))
        axes.fill_between(times, bottom, tops, step="post", color=colour, alpha=0.85, linewidth=0)
        axes.plot(times, tops, drawstyle="steps-post", color=colour, linewidth=1)
    style.rows_of_robots(axes, list(paths))
    axes.set(xlabel=style.TIME, title=f"{label}: filled = true")


def _look(index: int, robots: int, points: int) -> dict[str, Any]:
    """Return the style of one robot's line; `points`: the most that a line of the picture has."""
    dots = points <= DOTS and robots <= style.FEW
    return {
        "color": style.colour(index, robots),
        "linewidth": 1.1 if robots <= style.FEW else 0.6,
        "marker": style.mark(index) if dots else "",
        "markersize": 2.6,
    }


def _pace(path: Trajectory) -> str:
    """Return the mean time of an iteration, without the gaps."""
    ks, away = sorted(path.times)[1:], set(gaps(path))
    steps = [(path.times[after] - path.times[k], after - k) for k, after in itertools.pairwise(ks) if after not in away]
    if not steps:
        return "-"
    seconds = math.fsum(time for time, _ in steps) / sum(count for _, count in steps)
    return f"{1e3 * seconds:.3g} ms" if seconds < 1 else f"{seconds:.3g} s"
