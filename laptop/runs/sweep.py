"""`swarm.sweep`: many runs in virtual time from a program or a notebook, as a table."""

import contextlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from laptop.cli.runs import sweep_results
from laptop.cli.runs.sweep import WITHIN
from laptop.plotting import style
from laptop.runs.progress import progress as shown_progress
from laptop.runs.results import table_of
from laptop.runs.simulation import App, app_of, arguments_of, flags_of_options, settings_for
from sim.scenario.options import LATENCY, parse
from sim.sweep.engines import here, local
from sim.sweep.measure import Summary, SweptRun, check, summarize
from sim.sweep.plan import OPTIONS, Job, SweepPoint, points_of
from swarm.app.parameters import number_or_text
from swarm.core.arrays import is_array
from swarm.errors import ConfigError

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

OF_ALL_RUNS = ("faults", "iterations", "seconds", "seeds")
"""Arguments of a sweep that hold for all its runs, beside the options of `swarm sim`."""


class SweepTable:
    """The results of a sweep. Printed, it is a table with a row for each combination."""

    def __init__(self, app: str, points: Sequence[SweepPoint], found: Sequence[SweptRun]) -> None:
        self._app, self._points, self._found = app, points, found

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Return one row for each combination: the values that make it, and over all seeds `runs`, `failed`,
        `unsettled`, `settled` (iterations, median), `settled_most`, `error` (median), `error_most`, `iteration_s`,
        `problem` (the first), `never` (faults that did not happen), and each metric `error_NAME` of the app like
        `error`. None where a value is unknown."""
        runs = sweep_results.by_point(self._points, self._found)
        return [{**_values(point), **_flat(summarize(each))} for point, each in zip(self._points, runs, strict=True)]

    @property
    def runs(self) -> list[dict[str, Any]]:
        """Return one row for each combination and seed: the values, `seed`, `iterations`, `settled`, `error`,
        `seconds` (virtual), `iteration_s`, `computed_s`, `problem`, `never`, and the app's metrics `error_NAME`."""
        return [{**_values(self._points[run.point]), **_flat(run)} for run in self._found]

    def to_pandas(self) -> "pd.DataFrame":
        """Return `runs` as a table. Needs pandas, of the extra `notebook`."""
        return table_of(self.runs)

    def plot(self, path: str | Path | None = None) -> "Figure":
        """Draw iterations to settle, and the error, over the first list of numbers, as `swarm sweep --plot` does.
        Returns the figure, which a notebook shows; with `path` it is a file, too."""
        with style.figure(path, settings=style.RC, in_notebook=True, layout="constrained") as figure:
            sweep_results.draw_on(figure, self._app, self._points, self._found)
        return figure

    def __str__(self) -> str:
        return sweep_results.table(self._points, self._found)

    __repr__ = __str__


def sweep(
    app: App,
    over: Mapping[str, Sequence[Any]],
    *,
    seeds: int | Sequence[int] = 1,
    robots: int | None = None,
    topology: str | Path | None = None,
    values: Mapping[str, Any] | None = None,
    latency: float | str = LATENCY,
    faults: Sequence[str] = (),
    iterations: int | None = None,
    seconds: float | None = None,
    within: float = WITHIN,
    jobs: int = 1,
    progress: bool = True,
    **options: Any,
) -> SweepTable:
    """Run an app in virtual time for each combination of the lists in `over` and each seed, as `swarm sweep` does.

    `over`: lists by the name of a parameter or first value (`gain`, or `r2.gain` of one robot), and `robots`,
    `topology`, `algorithm`, `latency`, `jitter`, `loss`. Of a name of the radio that the app has, too, the app's is
    meant; `robots`, `topology` and `algorithm` are always the options. `seeds`: a number N for the seeds 1 to N, or a
    list of seeds. A run has settled when all results stay `within` of their last values. `jobs`: number of processes.
    More than one needs an app by name or file, and a script then calls `sweep` where `__name__` is `"__main__"`. The
    other arguments are those of `swarm.simulate`. A run with problems counts as failed. Raises `AppError` or
    `ConfigError` for an app or an argument with which no run is possible."""
    found = app_of(app)
    by_class = not isinstance(app, str | Path)
    if jobs < 1:
        raise ConfigError(f"jobs: expected a number of processes above zero, got {jobs}")
    if jobs > 1 and by_class:
        raise ConfigError("jobs: a class cannot go to other processes; put it into a file, and give its path")
    if not within >= 0.0:
        raise ConfigError(f"within: expected a distance of 0 or more, got {within}")
    kinds = found.algorithms.values()
    own = {name for kind in kinds for name in (*kind.spec.parameters, *kind.spec.schema.names)}
    given = {"robots": robots, "topology": topology, "latency": None if latency == LATENCY else latency, **options}
    fixed = {name for name, value in (values or {}).items() if not isinstance(value, Mapping)}
    fixed |= {name for name, value in given.items() if value is not None} - own
    points = _points(over, own, fixed)
    numbers = _seeds(seeds)
    planned: list[Job] = []
    for index, point in enumerate(points):
        chosen = dict(point.choices)
        count = int(chosen.pop("robots")) if "robots" in chosen else robots
        graph = chosen.pop("topology", topology)
        which = options | ({"algorithm": chosen.pop("algorithm")} if "algorithm" in chosen else {})
        delay = chosen.pop("latency") if "latency" in chosen.keys() - own else latency
        radio = {name: chosen.pop(name) for name in ("jitter", "loss") if name in chosen.keys() - own}
        words = arguments_of(count, graph, delay, faults, iterations, seconds, options | radio)
        for setting in settings_for(found, values, count, which):
            words += ["--set", setting.text]
        if "algorithm" in which:
            words += ["--algorithm", which["algorithm"]]
        for name, value in chosen.items():
            words += ["--set", f"{name}={value}"]
        name = found.name if by_class else str(app)
        parse([name, *words, "--virtual"], ends=False)  # what is wrong is said before anything is computed
        planned += [Job(index, seed, (name, *words, "--seed", str(seed)), within) for seed in numbers]
    check([job for job in planned if job.seed == planned[0].seed], found)
    engine = here(found) if jobs == 1 else local(jobs)
    with contextlib.ExitStack() as stack:
        look = stack.enter_context(shown_progress(f"{found.name}: {len(planned)} runs", shown=progress))
        run = stack.enter_context(engine)
        count = 0

        def done() -> None:
            nonlocal count
            count += 1
            look(count / len(planned))

        return SweepTable(found.name, points, run(planned, done))


def _points(over: Mapping[str, Sequence[Any]], own: Collection[str], fixed: Collection[str]) -> list[SweepPoint]:
    """Return the combinations of the lists in `over`. `own` are the app's parameters and first values, `fixed` what has
    one value for all runs. Raises `ConfigError`."""
    if not isinstance(over, Mapping):
        raise ConfigError(f'over: expected lists by name, such as {{"topology": ["line", "loop"]}}, got {over!r}')
    for name, choices in over.items():
        if name == "seed" and name not in own:
            raise ConfigError("over: a sweep has its seeds by seeds=..., a number of them or a list")
        if name in {*flags_of_options(), *OF_ALL_RUNS}.difference(own, OPTIONS):
            raise ConfigError(
                f"over: {name} is an argument of all runs of a sweep: call sweep once for each value, with {name}=...; "
                f"lists may be of {', '.join(OPTIONS)}, and of parameters and first values of the app"
            )
        if isinstance(choices, str) or not hasattr(choices, "__iter__"):
            raise ConfigError(f"over: {name}: expected a list of values, got {choices!r}")
        if name in fixed:
            raise ConfigError(f"over: {name} has one value for all runs, too: leave that out, or the list")
    points = points_of([], [(name, [_text(value) for value in choices]) for name, choices in over.items()])
    if not points:
        empty = ", ".join(name for name, choices in over.items() if not choices)
        raise ConfigError(f"over: {empty}: a list is empty, expected values")
    return points


def _seeds(seeds: int | Sequence[int]) -> Sequence[int]:
    """Return the seeds of a sweep. Raises `ConfigError`."""
    numbers = range(1, seeds + 1) if isinstance(seeds, int) else seeds
    if isinstance(numbers, str) or not isinstance(numbers, Sequence) or not numbers or min(numbers) < 0:
        raise ConfigError(f"seeds: {seeds!r}: expected a number of seeds above zero, or a list of seeds of 0 or more")
    return numbers


def _text(value: Any) -> str:
    """Return a value as `--set` takes it."""
    if isinstance(value, bool):
        return str(value).lower()
    if is_array(value):
        return _text(value.tolist())
    if isinstance(value, list | tuple):
        return f"[{','.join(map(_text, value))}]"
    return str(value)


def _flat(row: SweptRun | Summary) -> dict[str, Any]:
    """Return the fields of a run or a combination by name, with the app's metrics beside the rest."""
    return {name: x for name, x in asdict(row).items() if name not in ("point", "metrics")} | dict(row.metrics)


def _values(point: SweepPoint) -> dict[str, Any]:
    """Return the values of a combination, numbers as such."""
    return {name: number_or_text(text) for name, text in point.choices}
