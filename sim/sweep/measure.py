"""The measurement of one run of a sweep, in a process of its own, on this machine or on another."""

import contextlib
import logging
import math
import statistics
import sys
from collections.abc import Mapping, Sequence
from dataclasses import field

from services.apps.loader import LoadedApp
from services.apps.runner import ERROR
from sim.report import is_metric, metrics
from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.sweep.plan import Job
from sim.virtual.run import PLACE, run_virtually
from swarm.core.lockstep.stopping import is_unmet
from swarm.errors import SwarmError
from swarm.frozen import frozen
from swarm.recording.trajectory import Trajectory

LATE = 0.9
"""Share of the iterations after which a result that has settled moves no more."""


@frozen
class SweptRun:
    """Figures of one run."""

    point: int
    seed: int
    iterations: int
    settled: int | None
    """Iterations after which all results stay near their last values; None where they do not."""
    error: float | None
    """Error of the results, where the truth is known: from the mean (consensus), in cm (localization), else the mean of
    the app's `error` over the robots."""
    seconds: float
    """Duration of the run in virtual time, s."""
    iteration_s: float | None
    computed_s: float
    problem: str
    """Why the run failed; empty where it did not."""
    contacts: int = 0
    """The number of times that two robots touched."""
    metrics: Mapping[str, float] = field(default_factory=dict)
    """Values of the app's methods `error_NAME` at the end, by name: the mean over the robots."""
    never: str = ""
    """Faults that were planned and did not happen, because the run ended before; empty where all did."""


def check(jobs: Sequence[Job], app: LoadedApp | None = None) -> None:
    """Raise the error of the first job where none of them can be run: then the command is wrong. `app`: see
    `measure`."""
    wrong = None
    for job in jobs:
        try:
            build(parse([*job.arguments, "--virtual"], ends=False), PLACE, app)
        except SwarmError as error:
            wrong = wrong or error
        else:
            return
    if wrong is not None:
        raise wrong


def measure(job: Job, app: LoadedApp | None = None) -> SweptRun:
    """Do a run and return its figures, also where it fails. `app`: the app that the job names, where it is loaded
    already."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)  # twenty runs at once would tell the same twenty times
    try:
        # Standard output is for the sweep's results: an app's module may print while it is imported.
        with contextlib.redirect_stdout(sys.stderr):
            report, outcome = run_virtually(*job.arguments, rows=True, app=app)
    except SwarmError as error:
        return SweptRun(job.point, job.seed, 0, None, None, 0.0, None, 0.0, str(error))
    finally:
        logging.disable(before)
    path_error = report.get("error", report.get("error_cm"))
    members = outcome.members
    own, paths = metrics(members), list(members.values())
    iteration = report["iteration_s_median"]
    return SweptRun(
        point=job.point,
        seed=job.seed,
        iterations=min((path.last for path in paths), default=0),
        settled=settled(paths, job.within),
        error=path_error if isinstance(path_error, float) and math.isfinite(path_error) else None,
        seconds=outcome.seconds,
        iteration_s=iteration if isinstance(iteration, float) else None,
        computed_s=outcome.computed_s or 0.0,
        problem="; ".join(each for each in outcome.problems if not is_unmet(each)),
        contacts=contacts if isinstance(contacts := outcome.scene.get("contacts"), int) else 0,
        never="; ".join(outcome.never),
        metrics={name: x for name, x in own.items() if name != ERROR and f"{name}_most" in own and type(x) is float},
    )


def settled(paths: Sequence[Trajectory], within: float) -> int | None:
    """Return the iterations after which every result of every robot stays `within` of its last value; None where a
    result still moves at the end, or there is none."""
    ends = [path.last for path in paths]
    if not ends or min(ends) < 1:
        return None
    found = 0
    for path in paths:
        columns = [name for name in path.columns if name.startswith("result.") and not is_metric(name)]
        for column in columns:
            last = path.value(path.last, column)
            for k in range(path.last, found - 1, -1):
                # What is no number (no estimate yet) is far from every number, and equal to itself.
                value = path.value(k, column)
                if not (abs(value - last) <= within or (math.isnan(value) and math.isnan(last))):
                    found = k + 1
                    break
    return found if found <= LATE * min(ends) else None


@frozen
class Summary:
    """Statistics over the runs of one point of a sweep."""

    runs: int
    failed: int
    """Number of runs with a problem."""
    unsettled: int
    """Number of runs without a problem whose results do not settle."""
    settled: float | None
    """Median of `settled` over the runs whose results settle."""
    settled_most: int | None
    error: float | None
    """Median of the error."""
    error_most: float | None
    iteration_s: float | None
    problem: str
    """The first problem."""
    contacts: int
    """The number of times that two robots touched, in all runs together."""
    never: str
    """The first fault that never happened, and in how many runs one did not; empty where all did."""
    metrics: Mapping[str, float]
    """For each of the app's methods `error_NAME` the median over the runs, and under `error_NAME_most` the largest."""


def summarize(runs: Sequence[SweptRun]) -> Summary:
    """Return the statistics over the runs of one point."""
    good = [run for run in runs if not run.problem]
    rounds = [run.settled for run in good if run.settled is not None]
    away = [run.never for run in runs if run.never]
    errors = [run.error for run in good if run.error is not None]
    times = [run.iteration_s for run in good if run.iteration_s is not None]
    return Summary(
        runs=len(runs),
        failed=len(runs) - len(good),
        unsettled=sum(run.settled is None for run in good),
        settled=statistics.median(rounds) if rounds else None,
        settled_most=max(rounds, default=None),
        error=statistics.median(errors) if errors else None,
        error_most=max(errors, default=None),
        iteration_s=statistics.median(times) if times else None,
        problem=next((run.problem for run in runs if run.problem), ""),
        contacts=sum(run.contacts for run in runs),
        never=f"{away[0]}; in {len(away)} of {len(runs)} runs" if away else "",
        metrics=_summed([run.metrics for run in good]),
    )


def _summed(found: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return `Summary.metrics` of several runs."""
    summed: dict[str, float] = {}
    for name in dict.fromkeys(name for each in found for name in each):
        values = [each[name] for each in found if name in each]
        summed |= {name: statistics.median(values), f"{name}_most": max(values)}
    return summed
