"""A sweep's results: a table for people, JSON for programs, a plot."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from laptop.plotting import style
from sim.sweep.limit import Bracket
from sim.sweep.measure import Summary, SweptRun, summarize
from sim.sweep.plan import SweepPoint
from swarm.errors import LocalError
from swarm.process.terminal import columns

_UNITS = {"consensus": " from the mean", "localization": " / cm"}
"""The units of the errors of the built-in apps."""

_NUMBERS = {
    "runs": "runs",
    "failed": "failed",
    "unsettled": "unsettled",
    "settled": "settled after",
    "settled_most": "at most",
    "error": "error",
    "error_most": "at most",
    "iteration_s": "s/iteration",
}


def by_point(points: Sequence[SweepPoint], found: Sequence[SweptRun]) -> list[list[SweptRun]]:
    """Return the runs of each point."""
    runs: list[list[SweptRun]] = [[] for _ in points]
    for run in found:
        runs[run.point].append(run)
    return runs


def table(points: Sequence[SweepPoint], found: Sequence[SweptRun]) -> str:
    """Return a table with a row for each point, and the failures."""
    sums = [summarize(runs) for runs in by_point(points, found)]
    names = [name for name, _ in points[0].choices] if points else []
    metrics = _metrics(sums)
    rows = [[*names, *_NUMBERS.values(), *(title for name in metrics for title in (name, "at most"))]]
    for point, each in zip(points, sums, strict=True):
        numbers = [getattr(each, name) for name in _NUMBERS]
        for name in metrics:
            numbers += [each.metrics.get(name), each.metrics.get(f"{name}_most")]
        rows.append([*(value for _, value in point.choices), *map(_shown, numbers)])
    text = "\n".join(columns(rows, right=True, rule=True))
    notes = [
        f"{word}{_named(point)}: {said}"
        for word, name in (("failed", "problem"), ("never", "never"), ("contacts", "contacts"))
        for point, each in zip(points, sums, strict=True)
        if (said := getattr(each, name))
    ]
    return "\n".join([text, *([""] if notes else []), *notes])


def limits(points: Sequence[SweepPoint], name: str, brackets: Sequence[Bracket]) -> str:
    """Return a table with a row for each point."""
    rows = [[*(name for name, _ in points[0].choices), f"{name} settles", "fails"]]
    for point, each in zip(points, brackets, strict=True):
        rows.append([*(value for _, value in point.choices), _shown(each.good), _shown(each.bad)])
    whys = [
        f"fails{_named(point)} {name}={_shown(each.bad)}: {each.why}"
        for point, each in zip(points, brackets, strict=True)
        if each.why
    ]
    return "\n".join([*columns(rows, right=True, rule=True), *([""] if whys else []), *whys])


def as_json(points: Sequence[SweepPoint], found: Sequence[SweptRun]) -> list[dict[str, object]]:
    """Return each point with its summary and its runs."""
    return [
        {**dict(point.choices), "summary": asdict(summarize(runs)), "runs": [_run(run) for run in runs]}
        for point, runs in zip(points, by_point(points, found), strict=True)
    ]


def draw(app: str, points: Sequence[SweepPoint], found: Sequence[SweptRun], path: Path) -> None:
    """Write the picture of a sweep to a file."""
    with style.figure(path, settings=style.RC, layout="constrained") as made:
        draw_on(made, app, points, found)


def draw_on(made: Any, app: str, points: Sequence[SweepPoint], found: Sequence[SweptRun]) -> None:
    """Draw iterations to settle and error over the first list of numbers, with a line for each combination of the
    others, and a cross at the top where a run has neither."""
    sums = [summarize(runs) for runs in by_point(points, found)]
    along = _along(points)
    lines: dict[str, list[tuple[float, Summary]]] = {}
    for index, (point, each) in enumerate(zip(points, sums, strict=True)):
        choices = dict(point.choices)
        x = float(choices.pop(along)) if along is not None else float(index)
        lines.setdefault(", ".join(f"{name} {value}" for name, value in choices.items()), []).append((x, each))
    kinds = {"settled": "iterations to settle", "error": f"error{_UNITS.get(app, '')}"}
    kinds = {name: what for name, what in kinds.items() if any(getattr(each, name) is not None for each in sums)}
    kinds |= {name: name for name in _metrics(sums)}
    if not kinds:
        raise LocalError(
            f"{app}: there is nothing to draw: no result settled (--within says how near its end it must stay), and "
            "the app has no error: give it `def error(self, truth)` (docs/how-to/apps/measure-the-error.md)"
        )
    made.set_size_inches(4.5 * len(kinds), 4)
    zeros = {name: zero for name in kinds if name != "settled" and (zero := _zero(sums, name)) is not None}
    marked = False
    panels = dict(zip(kinds, made.subplots(1, len(kinds), squeeze=False)[0], strict=True))
    for index, (label, each_line) in enumerate(lines.items()):
        look = {"color": style.colour(index, len(lines)), "marker": style.mark(index), "markersize": 4}
        for name, axes in panels.items():
            drawn = [(x, *_drawn(each, name)) for x, each in each_line if _drawn(each, name)]
            if drawn:
                xs, *both = zip(*drawn, strict=True)
                ys, tops = ([max(y, zeros.get(name, y)) for y in each] for each in both)
                axes.plot(xs, ys, "-", label=label or None, **look)
                axes.plot(xs, tops, ":", color=look["color"], marker="_")  # a point alone has no line
            if amiss := [x for x, each in each_line if each.failed or (name == "settled" and each.unsettled)]:
                axes.plot(amiss, [0.97] * len(amiss), "x", color=look["color"], transform=axes.get_xaxis_transform())
                marked = True
    for name, axes in panels.items():
        if along is None:  # nothing to be drawn along an axis of numbers
            ticks = [", ".join(value for _, value in point.choices) for point in points]
            axes.set_xticks(range(len(points)), ticks, rotation=20 if len(points) > 4 else 0)
        elif all(x.is_integer() for line in lines.values() for x, _ in line):
            style.integer_ticks(axes.xaxis)
        what = along or ", ".join(each for each, _ in points[0].choices)
        axes.set(xlabel=what, ylabel=kinds[name], title=f"{app}: median, and worst (dotted)")
        axes.grid(alpha=0.3)
    if marked:
        style.say_below(made, "× at the top: a run failed there, or did not settle")
    for name, axes in panels.items():
        numbers = [value for each in sums for value in _drawn(each, name)]
        if numbers and not any(numbers):
            axes.set_ylim(-0.05, 1.0)
            axes.text(0.5, 0.5, "exactly 0 in all runs", transform=axes.transAxes, ha="center", color="0.4")
    for name, zero in zeros.items():
        axes = panels[name]
        axes.set_yscale("log")
        if any(0.0 in _drawn(each, name) for each in sums):
            axes.axhline(zero, color="0.6", linewidth=0.8, zorder=0)
            axes.text(1.0, zero, "exactly 0", transform=axes.get_yaxis_transform(), color="0.4")
    if any(lines) and along is not None:
        named = {
            label: line
            for axes in panels.values()
            for line, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        made.legend(named.values(), named.keys(), loc="outside upper center", ncols=2, fontsize="small")


def _drawn(each: Summary, name: str) -> tuple[float, ...]:
    """Return what is drawn of a point: the median and the worst, or nothing."""
    known = {**asdict(each), **each.metrics}
    return () if known.get(name) is None else (known[name], known[f"{name}_most"])


def _zero(sums: Sequence[Summary], name: str) -> float | None:
    """Return where a logarithmic axis has the errors that are exactly 0: a decade below the smallest other one. None
    where there is no such axis: all are 0, or one has a sign."""
    values = [y for each in sums for y in _drawn(each, name)]
    if not any(values) or min(values) < 0.0:
        return None
    return float(10.0 ** (math.floor(math.log10(min(y for y in values if y > 0.0))) - 1))


def _metrics(sums: Sequence[Summary]) -> list[str]:
    """Return the names of the app's methods `error_NAME` that gave numbers."""
    known = dict.fromkeys(name for each in sums for name in each.metrics)
    return [name for name in known if f"{name}_most" in known]


def _along(points: Sequence[SweepPoint]) -> str | None:
    """Return the first choice that has several values, all of them numbers."""
    for place, (name, _) in enumerate(points[0].choices):
        values = {point.choices[place][1] for point in points}
        if len(values) > 1 and all(map(_is_number, values)):
            return name
    return None


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _run(run: SweptRun) -> dict[str, object]:
    return {name: value for name, value in asdict(run).items() if name != "point"}


def _named(point: SweepPoint) -> str:
    """Return the name of a point behind the first word of a note."""
    return "".join(f" {name}={value}" for name, value in point.choices)


def _shown(value: object) -> str:
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
