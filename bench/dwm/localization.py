"""The pose of a moving robot: the Kalman filter beside moving averages and multilateration, in the same seeded runs.

`python -m bench.dwm.localization PICTURE.png` draws them. What is simulated, `bench.dwm.motion` says.
"""

import gc
import math
import sys
import time
import tracemalloc
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.dwm.motion import ANCHORS, SEEDS, WARM_UP, Outcome, errors, lag, rms, run
from bench.rows import Row
from services.dwm.core.estimation.ekf import GATE, Ekf, EkfNoise
from services.dwm.core.estimation.filters import interpolated_percentile
from services.dwm.core.estimation.tracker import Tracker

SCENARIOS = (
    ("standing, 5 % hidden", 0.0, 0.05, 0.035),
    ("0.2 m/s, 5 % hidden", 0.2, 0.05, 0.025),
    ("0.5 m/s, 5 % hidden", 0.5, 0.05, 0.025),
    ("0.3 m/s, 20 % hidden", 0.3, 0.20, 0.030),
)
"""Name, speed in m/s, share without line of sight, largest good rms in m."""

CONSISTENT = 1.0 - math.sqrt(2.0 * GATE / math.pi) * math.exp(-GATE / 2.0) / math.erf(math.sqrt(GATE / 2.0))
"""Mean of the squared innovations over their variances, of ranges that a consistent filter accepts: 0.925. That of a
normal distribution which is cut off at the gate."""

RIVALS = ("IQR + MA3", "IQR + MA15", "multilateration", "least squares")
LAG_LIMIT_S = 0.08

UPDATE_BUDGET_S = 2.5e-3
"""CPU time on this kind of machine of the filter's share in a period of 100 ms: a Pi Zero 2 W is about ten times
slower, so that a quarter of one of its four cores is the most it could take."""

ALLOCATION_BUDGET = 8 * 1024
"""Bytes that one period may hold more at its peak than at its start."""


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    seeds: int = SEEDS
    periods: int = 500
    """Of 100 ms, whose cost is measured."""


FULL = Sizes()
SMOKE = Sizes(1, 20)


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    for name, speed, hidden, limit in SCENARIOS:
        outcomes = [run(speed, hidden, seed) for seed in range(sizes.seeds)]
        ours = _rms(outcomes, "EKF")
        yield Row(f"{name}: EKF, rms", ours, "m", limit, 1.0)
        for rival in RIVALS:
            yield Row(f"  beside {rival}", ours, "m", _rms(outcomes, rival), 1.0)
        yield Row("  95 % of the errors below", _percentile(outcomes, 95), "m", 2 * limit, 1.0)
        if speed > 0.0:
            yield Row("  lag", lag(outcomes, "EKF"), "s", LAG_LIMIT_S, 1.0)
        yield Row("  innovations out of their 95 % band", outside(outcomes), "", 0.05, 1.0)
        yield Row("  mean innovation, normalized", abs(math.log(nis(outcomes) / CONSISTENT)), "log", math.log(1.5), 1.0)
    seconds, peak = cost(sizes.periods)
    yield Row("EKF, 100 ms: odometry at 25 Hz, 4 ranges", seconds, "s", UPDATE_BUDGET_S, 1.0)
    yield Row("the same, memory held at its peak", peak, "B", ALLOCATION_BUDGET, 1.0)
    yield Row("the same with 100 Hz predictions, 9 states", full_rate_cost(sizes.periods), "s", UPDATE_BUDGET_S, 1.0)


def outside(outcomes: Sequence[Outcome]) -> float:
    """Share of the innovations in line of sight beyond 1.96 standard deviations: 5 % for a consistent filter."""
    told = [item for one in outcomes for item, unseen in zip(one.innovations, one.hidden, strict=True) if not unseen]
    return sum(item.error**2 > 3.84 * item.variance for item in told) / len(told)


def nis(outcomes: Sequence[Outcome]) -> float:
    """Mean of the squared innovations over their variances, of accepted ranges: `CONSISTENT` for such a filter."""
    told = [item for one in outcomes for item in one.innovations if item.accepted]
    return math.fsum(item.error**2 / item.variance for item in told) / len(told)


def cost(periods: int) -> tuple[float, int]:
    """CPU time (s) and memory held at its peak (bytes) of one period of 100 ms of a tracker that knows its heading:
    odometry at 25 Hz, a report of four ranges, the estimate."""
    tracker = _running()
    start = time.process_time()
    for k in range(periods):
        _period(tracker, 100 + k)
    seconds = (time.process_time() - start) / periods
    gc.collect()
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    _period(tracker, 100 + periods)
    peak = tracemalloc.get_traced_memory()[1] - before
    tracemalloc.stop()
    return seconds, peak


def full_rate_cost(periods: int) -> float:
    """CPU time (s) of ten predictions and four updates of the bare filter."""

    ekf = Ekf(tuple(ANCHORS.values()), 0.0, (1.0, 1.0), 0.0, 0.3, EkfNoise())
    start = time.process_time()
    for _ in range(periods):
        for _ in range(10):
            ekf.predict(0.0, 0.001, 0.01)
        for index, place in enumerate(ANCHORS.values()):
            ekf.update(index, math.dist((*ekf.state[:2], 0.0), place))
    return (time.process_time() - start) / periods


def _running() -> Tracker:
    tracker = Tracker(ANCHORS)
    for k in range(100):
        _period(tracker, k)
    estimate = tracker.estimate(10.0)
    assert estimate is not None and estimate.heading is not None and tracker.restarts == 0  # noqa: PT018
    return tracker


def _period(tracker: Tracker, k: int) -> None:
    """The k-th 100 ms of a robot that goes round (1, 1) at 0.2 m/s with a radius of 0.4 m."""
    for i in range(-(-5 * k // 2), -(-5 * (k + 1) // 2)):
        tracker.odometry(0.04 * i, 0.2 * 0.04, 0.5 * 0.04)
    t = 0.1 * (k + 1)
    angle = 0.5 * (t - 0.06)
    x, y = 1.0 + 0.4 * math.cos(angle), 1.0 + 0.4 * math.sin(angle)
    tracker.ranges(t, [(name, math.dist((x, y, 0.0), place)) for name, place in ANCHORS.items()])
    tracker.estimate(t)


def _rms(outcomes: Sequence[Outcome], method: str) -> float:
    return rms([error for one in outcomes for error in errors(one, method)])


def _percentile(outcomes: Sequence[Outcome], percent: float) -> float:
    return interpolated_percentile([error for one in outcomes for error in errors(one, "EKF")], percent)


def draw(path: Path) -> None:
    """One run at 0.5 m/s on the map, and the errors of all methods over all speeds."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    methods = ("EKF", *RIVALS[:3])
    colours = ("#d55e00", "#0072b2", "#009e73", "0.6")
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.8), layout="constrained")
    shown = run(0.5, 0.05, 3)
    part = [pose for pose in shown.truth if WARM_UP < pose.t < WARM_UP + 12]
    left.plot([pose.x for pose in part], [pose.y for pose in part], color="black", linewidth=1, label="true")
    for method, colour in zip(methods, colours, strict=True):
        path_of = [(x, y) for t, x, y in shown.paths[method] if WARM_UP < t < WARM_UP + 12]
        style = {"marker": ".", "linestyle": ""} if method == "multilateration" else {}
        left.plot(*zip(*path_of, strict=True), color=colour, label=method, markersize=4, linewidth=1.2, **style)
    left.plot(*zip(*[place[:2] for place in ANCHORS.values()], strict=True), "^", color="black")
    left.set_aspect("equal")
    left.set_xlim(-0.2, 2.2)
    left.set_ylim(-0.2, 2.2)
    left.set_xlabel("x (m)")
    left.set_ylabel("y (m)")
    left.set_title("12 s at 0.5 m/s")
    left.legend(fontsize=8, loc="upper left")
    for index, (name, speed, hidden, _) in enumerate(SCENARIOS):
        outcomes = [run(speed, hidden, seed) for seed in range(SEEDS)]
        for shift, (method, colour) in enumerate(zip(methods, colours, strict=True)):
            right.bar(
                index + 0.2 * (shift - 1.5),
                100 * _rms(outcomes, method),
                0.2,
                color=colour,
                label=method if index == 0 else None,
            )
        right.text(index, -4, name.replace(", ", "\n"), ha="center", fontsize=8)
    right.set_xticks([])
    right.set_ylabel("rms error (cm)")
    right.set_title(f"{SEEDS} runs of a minute each")
    right.legend(fontsize=8)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
