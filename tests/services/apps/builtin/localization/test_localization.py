"""Cooperative localization: the closed form against numpy, consensus on statistics."""

import math
import random
import statistics

import numpy as np
import pytest
from conftest import costly, thinned
from hypothesis import example, given
from hypothesis import strategies as st
from localization_rig import Point, exact, measured, noisy, recorded, rounds_to_own_limit
from memory_swarm import ANCHORS, PLACES, TARGET, MemorySwarm, config_of

from services.apps.builtin.localization import ranges
from services.apps.builtin.localization.leastsquares import refine
from swarm.messages import Measurement


def together(places: list[Point], distances: list[float], sigma: float = 0.05) -> ranges.Statistics:
    parts = [ranges.statistics(d, *p, sigma) for p, d in zip(places, distances, strict=True)]
    return tuple(math.fsum(column) / len(parts) for column in zip(*parts, strict=True))


def squared_range_cost(places: list[Point], distances: list[float], sigma: float, at: np.ndarray) -> np.ndarray:
    """Weighted cost at points `at` (..., 2)."""
    p, d = np.array(places), np.array(distances)
    squares = ((at[..., None, :] - p) ** 2).sum(-1)
    return (((squares - d**2) ** 2) / (4 * np.maximum(d, ranges.SHORTEST) ** 2 * sigma**2)).sum(-1)


# The closed form


@costly(150)
@given(
    st.lists(st.tuples(st.floats(-2, 2), st.floats(-2, 2)), min_size=1, max_size=7),
    st.tuples(st.floats(-2, 2), st.floats(-2, 2)),
    st.integers(0, 2**32),
)
@example([(0.03125, 0.03125), (0.03125, 0.0), (0.0, 1.0)], (0.0, -0.5625), 0)
@example([(1.0, 2.0), (0.0, 0.40625), (0.0, 0.3125)], (1.0, 2.0), 251592713)
@example([(1.0, 2.0), (0.0, 0.25), (0.0, 0.3125)], (1.0, 2.0), 251592713)
@example([(0.0, 0.0), (0.0, 1.0), (0.001953125, 0.0)], (0.0, -1.0), 219)
def test_the_closed_form_is_the_global_minimum(places: list[Point], target: Point, seed: int) -> None:
    numbers = random.Random(seed)
    distances = [abs(math.dist(p, target) + numbers.gauss(0, 0.1)) for p in places]
    sums = together(places, distances)
    found = ranges.solve(sums, len(places))
    assert found is not None
    assert found.rank in (1, 2, 3)
    if found.rank == 1:
        return
    side = np.linspace(-4, 4, 161)
    grid = squared_range_cost(places, distances, 0.05, np.stack(np.meshgrid(side, side), -1))
    here = squared_range_cost(places, distances, 0.05, np.array([found.x, found.y]))
    lost = 0.0
    if found.rank == 2:
        # Places that are within a millimetre of a line are taken for one, and what they tell of its sides is lost: of
        # each robot's residual a part of side h, whose squares are small h^2 altogether, where small <= 4 w 1e-6 m^2.
        reach = max(math.dist(p, (found.x, found.y)) for p in places)
        lost = len(places) * 4 * sums[5] * (ranges.SMALLEST_SPREAD * reach) ** 2

    def at_most(cost: float) -> float:
        """The cost of what is best without that part, where `cost` is the least with it: residuals are added as
        vectors, once where each of the two costs is least."""
        return (math.sqrt(cost) + 2 * math.sqrt(lost)) ** 2 * (1 + 1e-6) + 1e-3

    assert here <= at_most(grid.min())
    if found.other is not None:
        around = np.array(found.other) + 1e-3 * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
        costs = squared_range_cost(places, distances, 0.05, around)
        assert costs[0] <= at_most(costs.min())
        assert costs[0] <= at_most(here) + ranges.DECIDED


def test_exact_ranges_give_the_target() -> None:
    found = ranges.solve(together(list(PLACES[:3]), [math.dist(p, TARGET) for p in PLACES[:3]]), 3)
    assert found is not None
    assert (found.x, found.y) == pytest.approx(TARGET, abs=1e-12)
    assert found.rank == 3
    assert not found.ambiguous


def test_two_robots_leave_two_candidates() -> None:
    found = ranges.solve(together(list(PLACES[:2]), [math.dist(p, TARGET) for p in PLACES[:2]]), 2)
    assert found is not None
    assert found.rank == 2
    assert found.ambiguous
    assert found.other is not None
    errors = sorted(math.dist(candidate, TARGET) for candidate in ((found.x, found.y), found.other))
    assert errors[0] < 1e-9
    assert errors[1] == pytest.approx(math.dist((0.9, 1.2), TARGET), abs=1e-9)  # the mirror image


def test_robots_nearly_in_line_leave_two_candidates() -> None:
    """Three standard deviations do not tell the sides apart, so the numbers must not claim to."""
    places = [(0.0, 0.0), (1.0, 0.0), (2.0, 0.05)]
    found = ranges.solve(together(places, [math.dist(p, (0.3, 0.7)) + 0.02 for p in places]), 3)
    assert found is not None
    assert found.rank == 3
    assert found.ambiguous


def test_a_target_on_the_line_of_the_robots_is_one_place() -> None:
    places = [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)]
    found = ranges.solve(together(places, [math.dist(p, (0.3, 0.0)) for p in places]), 3)
    assert found is not None
    assert (found.x, found.y) == pytest.approx((0.3, 0.0), abs=1e-9)
    assert not found.ambiguous


def test_one_robot_gives_a_circle() -> None:
    found = ranges.solve(together([(0.5, 1.5)], [0.5]), 1)
    assert found == ranges.TargetEstimate(0.5, 1.5, None, 1, (pytest.approx(0.125), 0.0, pytest.approx(0.125)))
    assert found.sigma == pytest.approx(0.5)
    assert found.ambiguous


def test_nothing_measured_gives_nothing() -> None:
    assert ranges.solve(ranges.NOTHING, 3) is None


def test_what_is_no_sum_of_ranges_gives_nothing() -> None:
    far, near = together([(0.0, 0.0), (1.0, 0.2)], [1.0, 0.8]), together([(0.0, 0.0), (0.0, 1.0)], [1.0, 0.8])
    one = ranges.statistics(0.9, 0.9, 0.9, 0.05)
    assert ranges.solve(tuple([a - 2 * b for a, b in zip(far, one, strict=True)]), 3) is None  # of negative weight
    assert ranges.solve(tuple([a - 0.7 * b for a, b in zip(far, near, strict=True)]), 3) is None  # of negative spread


def test_sigma_is_the_spread_of_the_estimates() -> None:
    """The reported deviation against 400 draws, and within a tenth of the Cramer-Rao bound."""
    numbers = random.Random(5)
    sigma = math.hypot(0.04, 0.035)
    errors, claimed, spread = [], [], []
    for _ in range(400):
        distances = [math.dist(p, TARGET) + numbers.gauss(0, sigma) for p in PLACES[:3]]
        found = ranges.solve(together(list(PLACES[:3]), distances, sigma), 3)
        assert found is not None
        errors.append(math.dist((found.x, found.y), TARGET) ** 2)
        claimed.append(found.sigma)
        spread.append(
            ((found.x - TARGET[0]) ** 2, (found.x - TARGET[0]) * (found.y - TARGET[1]), (found.y - TARGET[1]) ** 2)
        )
    # The whole matrix, of the last draw: it hardly depends on the noise.
    for part, told in zip(np.mean(spread, axis=0), found.covariance, strict=True):
        assert part == pytest.approx(told, abs=0.15 * max(found.covariance))
    assert math.sqrt(sum(errors) / 400) == pytest.approx(0.0664, rel=0.1)
    assert sum(claimed) / 400 == pytest.approx(0.0621, rel=0.05)


# Consensus on the statistics


@pytest.mark.parametrize(
    ("count", "shape", "rounds"),
    thinned([(3, "line", 5), (6, "line", 18), (6, "loop", 5), (6, "thesis-d", 4), (6, "full", 1)]),
)
def test_info_needs_few_rounds_to_its_own_limit(count: int, shape: str, rounds: int) -> None:
    """Median over draws of the noise; that limit is where all data together put the target."""
    config = config_of(count, shape, "localization")
    found = []
    for seed in range(9):
        readings = {name: noisy(f"r{name[1:]}", seed) for name in config.names}
        swarm = MemorySwarm("localization", config, 100, lambda name, k, readings=readings: readings[name])
        found.append(rounds_to_own_limit(swarm))
        places = [(m.x, m.y) for m in readings.values()]
        distances = [m.distance for m in readings.values()]
        best = ranges.solve(together(places, distances, math.hypot(0.04, 0.035)), count)
        assert best is not None
        for result in swarm.final.values():
            assert (result["x"], result["y"]) == pytest.approx((best.x, best.y), abs=1e-4)
            assert not result["ambiguous"]
    assert statistics.median(found) <= rounds


@pytest.mark.parametrize("test", ["test_3", "test_5"])
def test_info_needs_five_rounds_on_recorded_ranges(test: str) -> None:
    """The thesis' gradient needs 44 and 401 on them."""
    rows = recorded(test)
    middle = len(rows["r0"]) // 2

    def measure(name: str, k: int) -> Measurement:
        return measured(rows[name][middle])

    assert rounds_to_own_limit(MemorySwarm("localization", config_of(3, "line", "localization"), 60, measure)) <= 5


def test_the_statistics_keep_their_sum_while_ranges_change() -> None:
    """Dynamic average consensus: the sum of all q is that of all smoothed measurements, at every k."""
    swarm = MemorySwarm("localization", config_of(6, "thesis-d", "localization"), 60, noisy)
    app = swarm.runners["r0"].app
    ox, oy = app.origin()
    own = {}
    for k in range(61):
        for name in swarm.runners:
            m = noisy(name, max(k - 1, 0))
            new = ranges.statistics(m.distance, m.x - ox, m.y - oy, math.hypot(0.04, 0.035))
            beta = 1.0 if k == 0 else 0.1
            own[name] = [o + beta * (n - o) for o, n in zip(own.get(name, new), new, strict=True)]
        for i in range(9):
            total = math.fsum(states[k]["q"][i] for states in swarm.states.values())
            assert total == pytest.approx(math.fsum(m[i] for m in own.values()), rel=1e-11, abs=1e-9)
    for result in swarm.final.values():
        assert math.dist((result["x"], result["y"]), TARGET) < 0.1


def test_info_falls_back_on_its_own_range_while_the_target_leaves_a_robot() -> None:
    """From 5 cm beside r0 at 6 cm an iteration: r0 takes back more weight than has come back to it."""

    def leaving(name: str, k: int) -> Measurement:
        place = PLACES[int(name[1:])]
        return Measurement(
            0.0, k, math.dist(place, (PLACES[0][0], PLACES[0][1] - 0.05 - 0.06 * max(k - 20, 0))), *place
        )

    swarm = MemorySwarm("localization", config_of(6, "line", "localization"), 40, leaving)
    alone = [result for results in swarm.results.values() for result in results[1:] if result["rank"] == 1]
    assert alone
    assert all(result["ambiguous"] and result["sigma"] > 0.04 for result in alone)
    assert all(result["rank"] for results in swarm.results.values() for result in results)
    assert all(math.dist((r["x"], r["y"]), TARGET) < 5.0 for results in swarm.results.values() for r in results)


def test_info_says_ambiguous_when_two_robots_are_all_there_is() -> None:
    swarm = MemorySwarm("localization", config_of(2, "line", "localization"), 30, exact)
    for result in swarm.final.values():
        assert result["ambiguous"]
        assert result["rank"] == 2
        candidates = ((result["x"], result["y"]), (result["other_x"], result["other_y"]))
        assert min(math.dist(candidate, TARGET) for candidate in candidates) < 1e-9


def test_the_origin_is_the_mean_of_the_anchors() -> None:
    far = [type(a)(a.address, a.x + 300, a.y - 200) for a in ANCHORS]
    config = config_of(3, "line", "localization", anchors=far)

    def measure(name: str, k: int) -> Measurement:
        m = exact(name, k)
        return Measurement(m.t, k, m.distance, m.x + 300, m.y - 200)

    swarm = MemorySwarm("localization", config, 300, measure, every=False)
    for result in swarm.final.values():
        assert (result["x"], result["y"]) == pytest.approx((TARGET[0] + 300, TARGET[1] - 200), abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("count", "shape"), [(3, "line"), (6, "line"), (6, "thesis-d")])
def test_info_errs_no_more_than_least_squares_of_all_ranges(count: int, shape: str) -> None:
    """Root mean square over 60 draws; least squares of the range residuals is what a central computer would do."""
    errors, central = [], []
    config = config_of(count, shape, "localization")
    for seed in range(60):
        readings = {name: noisy(name, seed) for name in config.names}
        frozen = lambda name, k, readings=readings: readings[name]  # noqa: E731
        swarm = MemorySwarm("localization", config, 40, frozen, every=False)
        errors += [math.dist((r["x"], r["y"]), TARGET) ** 2 for r in swarm.final.values()]
        best = refine([(m.distance, m.x, m.y) for m in readings.values()], TARGET)
        central.append(math.dist(best, TARGET) ** 2)
    assert math.sqrt(statistics.fmean(errors)) <= 1.02 * math.sqrt(statistics.fmean(central))


@pytest.mark.parametrize(("test", "settled"), thinned([("test_2", 50), ("test_3", 50), ("test_5", 50)]))
def test_info_errs_no_more_than_least_squares_of_the_recorded_ranges(test: str, settled: int) -> None:
    """The same smoothing for both: root mean square over the run, all robots."""
    rows = recorded(test)
    last = min(map(len, rows.values()))
    names = list(rows)

    def measure(name: str, k: int) -> Measurement:
        return measured(rows[name][k])

    swarm = MemorySwarm("localization", config_of(3, "line", "localization"), last, measure)
    smooth = {name: (lambda m: np.array([m.distance, m.x, m.y]))(measure(name, 0)) for name in names}
    errors, central = [], []
    for k in range(1, last + 1):
        for name in names:
            now = measure(name, k - 1)
            smooth[name] += 0.1 * (np.array([now.distance, now.x, now.y]) - smooth[name])
        if k >= settled:
            errors += [math.dist((r[k]["x"], r[k]["y"]), TARGET) ** 2 for r in swarm.results.values()]
            central.append(math.dist(refine([tuple(s) for s in smooth.values()], TARGET), TARGET) ** 2)
    assert math.sqrt(statistics.fmean(errors)) <= 1.02 * math.sqrt(statistics.fmean(central))
