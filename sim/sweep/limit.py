"""The largest value of a parameter with which an app still settles, by bisection, for each point and all seeds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sim.sweep.engines import Engine
from sim.sweep.measure import SweptRun
from sim.sweep.plan import SweepPoint, jobs_of

PRECISION = 0.01
"""Share of the largest value by which it may be wrong."""


@dataclass
class Bracket:
    """The bounds known of one point."""

    good: float | None = None
    """The largest value with which all runs settled; None where none did."""
    bad: float | None = None
    """The smallest value with which a run did not settle."""
    why: str = ""
    """The reason at the smallest value: the first problem of its runs, or that their results do not settle."""


def _failed(run: SweptRun) -> bool:
    return bool(run.problem) or run.settled is None


def search(
    app: str,
    points: Sequence[SweepPoint],
    seeds: Sequence[int],
    rest: Sequence[str],
    within: float,
    name: str,
    bounds: tuple[float, float],
    engine: Engine,
    done: Callable[[], None],
) -> list[Bracket]:
    """Bisect between `bounds`; a point that settles at the upper one, or fails at the lower one, is left there.

    Assumes that what is larger than a value that fails fails too. All points go on side by side.
    """
    low, high = bounds
    brackets = [Bracket() for _ in points]

    def judge(values: dict[int, float]) -> None:
        tried = [points[index].with_value(name, value) for index, value in values.items()]
        found = engine(jobs_of(app, tried, seeds, rest, within), done)
        for place, (index, value) in enumerate(values.items()):
            whys = [run.problem or "the results do not settle" for run in found if run.point == place and _failed(run)]
            if whys:
                brackets[index].bad, brackets[index].why = value, whys[0]
            else:
                brackets[index].good = value

    judge(dict.fromkeys(range(len(points)), low))
    judge({index: high for index, each in enumerate(brackets) if each.good is not None})
    while True:
        open_ = {
            index: 0.5 * (each.good + each.bad)
            for index, each in enumerate(brackets)
            if each.good is not None and each.bad is not None and each.bad - each.good > PRECISION * each.bad
        }
        if not open_:
            return brackets
        judge(open_)
