"""A sweep's results: a table for people, JSON for programs, a plot."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from laptop.plotting import style
from laptop.plotting.style import figure
from sim.sweep.limit import Bracket
from sim.sweep.measure import Summary, SweptRun, summarize
from sim.sweep.plan import Point
from swarm.process.terminal import columns

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


def by_point(points: Sequence[Point], found: Sequence[SweptRun]) -> list[list[SweptRun]]:
    """The runs of each point."""
    runs: list[list[SweptRun]] = [[] for _ in points]
    for run in found:
        runs[run.point].append(run)
    return runs


def table(points: Sequence[Point], found: Sequence[SweptRun]) -> str:
    """A row for each point, and what failed."""
    sums = [summarize(runs) for runs in by_point(points, found)]
    names = [name for name, _ in points[0].choices] if points else []
    rows = [[*names, *_NUMBERS.values()]]
    for point, each in zip(points, sums, strict=True):
        rows.append([*(value for _, value in point.choices), *(_shown(getattr(each, name)) for name in _NUMBERS)])
    text = _aligned(rows)
    problems = [
        f"failed {_named(point)}: {each.problem}" for point, each in zip(points, sums, strict=True) if each.problem
    ]
    return "\n".join([text, *([""] if problems else []), *problems])


def limits(points: Sequence[Point], name: str, brackets: Sequence[Bracket]) -> str:
    """A row for each point."""
    rows = [[*(name for name, _ in points[0].choices), f"{name} settles", "fails"]]
    for point, each in zip(points, brackets, strict=True):
        rows.append([*(value for _, value in point.choices), _shown(each.good), _shown(each.bad)])
    return _aligned(rows)


def as_json(points: Sequence[Point], found: Sequence[SweptRun]) -> list[dict[str, object]]:
    """Each point with its summary and its runs."""
    return [
        {**dict(point.choices), "summary": asdict(summarize(runs)), "runs": [_run(run) for run in runs]}
        for point, runs in zip(points, by_point(points, found), strict=True)
    ]


def draw(app: str, points: Sequence[Point], found: Sequence[SweptRun], path: Path) -> None:
    """Iterations to settle and error over the first list of numbers, a line for each combination of the others."""
    sums = [summarize(runs) for runs in by_point(points, found)]
    along = _along(points)
    lines: dict[str, list[tuple[float, Summary]]] = {}
    for index, (point, each) in enumerate(zip(points, sums, strict=True)):
        choices = dict(point.choices)
        x = float(choices.pop(along)) if along is not None else float(index)
        lines.setdefault(", ".join(f"{name} {value}" for name, value in choices.items()), []).append((x, each))
    with figure(path, settings=style.RC, figsize=(9, 4), layout="constrained") as made:
        left, right = made.subplots(1, 2)
        for index, (label, each_line) in enumerate(lines.items()):
            look = {"color": style.colour(index, len(lines)), "marker": style.mark(index), "markersize": 4}
            for axes, middle, most in ((left, "settled", "settled_most"), (right, "error", "error_most")):
                drawn = [
                    (x, getattr(s, middle), getattr(s, most)) for x, s in each_line if getattr(s, middle) is not None
                ]
                if drawn:
                    xs, ys, tops = zip(*drawn, strict=True)
                    axes.plot(xs, ys, "-", label=label or None, **look)
                    axes.plot(xs, tops, ":", color=look["color"])
        unit = {"consensus": " from the mean", "localization": " / cm"}.get(app, "")
        for axes, what in ((left, "iterations to settle"), (right, f"error{unit}")):
            axes.set(xlabel=along or "combination", ylabel=what, title=f"{app}: median, and worst (dotted)")
            axes.grid(alpha=0.3)
        right.set_yscale("log", nonpositive="mask")  # exact to the last bit: no point
        if any(lines):
            made.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=2, fontsize="small")


def _along(points: Sequence[Point]) -> str | None:
    """The first choice that has several values, all numbers."""
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


def _named(point: Point) -> str:
    return " ".join(f"{name}={value}" for name, value in point.choices)


def _shown(value: object) -> str:
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    rule = ["-" * max(map(len, cells)) for cells in zip(*rows, strict=True)]
    return "\n".join(columns([rows[0], rule, *rows[1:]], right=True))
