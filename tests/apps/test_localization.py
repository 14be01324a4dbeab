"""Cooperative localization: closed form against numpy, consensus on statistics, the thesis' gradient and recordings."""

import csv
import math
import os
import random
import statistics
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_swarm import ANCHORS, PLACES, TARGET, MemorySwarm, config_of

from services.apps.localization import guard, ranges
from services.apps.localization.gradient import Node, iterate
from swarm.core.graph import Graph
from swarm.errors import AppError
from swarm.messages import Measurement

Point = tuple[float, float]

RECORDINGS = Path(os.environ.get("SWARM_THESIS_DATA") or Path(__file__).parents[3] / "shared" / "thesis-data")


def exact(name: str, k: int) -> Measurement:
    place = PLACES[int(name[1:])]
    return Measurement(0.0, k, math.dist(place, TARGET), *place)


def noisy(name: str, k: int) -> Measurement:
    numbers = random.Random(f"{name} {k}")
    place = PLACES[int(name[1:])]
    x, y = (c + numbers.gauss(0, 0.035) for c in place)
    return Measurement(0.0, k, math.dist(place, TARGET) + numbers.gauss(0, 0.04), x, y)


def recorded(test: str) -> dict[str, list[list[float]]]:
    """The lines of new states (flag 0) of each robot; the columns are in thesis-data/README.md."""
    folder = RECORDINGS / "localization" / test
    if not folder.is_dir():
        pytest.skip(f"{folder}: no thesis recordings here (SWARM_THESIS_DATA names their folder)")
    rows = {}
    for index in range(3):
        with (folder / f"{index}.csv").open() as file:
            lines = [[float(cell) for cell in line] for line in csv.reader(file)]
        rows[f"r{index}"] = [line for line in lines if len(line) == 12 and line[7] == 0]
    return rows


def measured(row: list[float]) -> Measurement:
    return Measurement(0.0, 0, row[9] / 100, row[10] / 100, row[11] / 100)


def together(places: list[Point], distances: list[float], sigma: float = 0.05) -> ranges.Statistics:
    parts = [ranges.statistics(d, *p, sigma) for p, d in zip(places, distances, strict=True)]
    return tuple(math.fsum(column) / len(parts) for column in zip(*parts, strict=True))


def squared_range_cost(places: list[Point], distances: list[float], sigma: float, at: np.ndarray) -> np.ndarray:
    """Weighted cost at points `at` (..., 2)."""
    p, d = np.array(places), np.array(distances)
    squares = ((at[..., None, :] - p) ** 2).sum(-1)
    return (((squares - d**2) ** 2) / (4 * np.maximum(d, ranges.SHORTEST) ** 2 * sigma**2)).sum(-1)


# The closed form


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-2, 2), st.floats(-2, 2)), min_size=1, max_size=7),
    st.tuples(st.floats(-2, 2), st.floats(-2, 2)),
    st.integers(0, 2**32),
)
def test_the_closed_form_is_the_global_minimum(places: list[Point], target: Point, seed: int) -> None:
    numbers = random.Random(seed)
    distances = [abs(math.dist(p, target) + numbers.gauss(0, 0.1)) for p in places]
    found = ranges.solve(together(places, distances), len(places))
    assert found is not None
    assert found.rank in (1, 2, 3)
    if found.rank == 1:
        return
    side = np.linspace(-4, 4, 161)
    grid = squared_range_cost(places, distances, 0.05, np.stack(np.meshgrid(side, side), -1))
    here = squared_range_cost(places, distances, 0.05, np.array([found.x, found.y]))
    assert here <= grid.min() * (1 + 1e-6) + 1e-3  # the grid's floor; within a millimetre places are one
    if found.other is not None:
        around = np.array(found.other) + 1e-3 * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
        costs = squared_range_cost(places, distances, 0.05, around)
        assert costs[0] <= costs.min() * (1 + 1e-6) + 1e-3
        assert costs[0] - here < ranges.DECIDED + 1e-3


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
    assert found == ranges.Estimate(0.5, 1.5, None, 1, pytest.approx(0.5))
    assert found.ambiguous


def test_nothing_measured_gives_nothing() -> None:
    assert ranges.solve(ranges.NOTHING, 3) is None


def test_sigma_is_the_spread_of_the_estimates() -> None:
    """The reported deviation against 400 draws, and within a tenth of the Cramer-Rao bound."""
    numbers = random.Random(5)
    sigma = math.hypot(0.04, 0.035)
    errors, claimed = [], []
    for _ in range(400):
        distances = [math.dist(p, TARGET) + numbers.gauss(0, sigma) for p in PLACES[:3]]
        found = ranges.solve(together(list(PLACES[:3]), distances, sigma), 3)
        assert found is not None
        errors.append(math.dist((found.x, found.y), TARGET) ** 2)
        claimed.append(found.sigma)
    assert math.sqrt(sum(errors) / 400) == pytest.approx(0.0664, rel=0.1)
    assert sum(claimed) / 400 == pytest.approx(0.0621, rel=0.05)


# Consensus on the statistics


def rounds_to_own_limit(swarm: MemorySwarm) -> int:
    """Rounds until all robots stay within 1 cm of their last estimates."""
    names = list(swarm.results)
    last = len(swarm.results[names[0]]) - 1

    def place(name: str, k: int) -> Point:
        return swarm.results[name][k]["x"], swarm.results[name][k]["y"]

    worst = [max(math.dist(place(name, k), place(name, last)) for name in names) for k in range(last + 1)]
    return max(k for k, error in enumerate(worst) if error >= 0.01) + 1


@pytest.mark.parametrize(
    ("count", "shape", "rounds"),
    [(3, "line", 5), (6, "line", 18), (6, "loop", 5), (6, "thesis-d", 4), (6, "full", 1)],
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
    ox, oy = app._origin()
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

    swarm = MemorySwarm("localization", config, 300, measure)
    for result in swarm.final.values():
        assert (result["x"], result["y"]) == pytest.approx((TARGET[0] + 300, TARGET[1] - 200), abs=1e-9)


# The thesis' gradient tracking


@pytest.mark.parametrize(("gamma_cm", "rounds"), [(4e-6, 44), (5e-7, 395)])
def test_the_thesis_needs_as_many_iterations_as_known(gamma_cm: float, rounds: int) -> None:
    """To within 1 cm on exact data, 3-line (the thesis says 50 and 400)."""
    parameters = {"algorithm": "thesis", "step_size": gamma_cm * 1e4}
    swarm = MemorySwarm("localization", config_of(3, "line", "localization", parameters), rounds + 1, exact)
    worst = [max(math.dist((r[k]["x"], r[k]["y"]), TARGET) for r in swarm.results.values()) for k in range(rounds + 2)]
    # State 0 is the start, and the first step only finds the first gradient: the count of moves is k - 1.
    reached = next(k for k, error in enumerate(worst) if error < 0.01)
    assert reached - 1 in (rounds - 1, rounds)


@pytest.mark.parametrize(("test", "gamma_cm"), [("test_2", 4e-6), ("test_3", 4e-6), ("test_5", 5e-7)])
def test_the_thesis_follows_its_recorded_trajectories(test: str, gamma_cm: float) -> None:
    """Row k of a recording takes state k to k + 1; its own columns x, y are that state. Within 0.001 cm."""
    rows = recorded(test)
    last = min(map(len, rows.values()))
    assert last > 500

    def measure(name: str, k: int) -> Measurement:
        return measured(rows[name][k])

    parameters = {"algorithm": "thesis", "step_size": gamma_cm * 1e4}
    swarm = MemorySwarm("localization", config_of(3, "line", "localization", parameters), last, measure)
    deviation = max(
        math.dist((100 * state["x"][0], 100 * state["x"][1]), rows[name][k][1:3])
        for name, states in swarm.states.items()
        for k, state in enumerate(states[1:])
    )
    assert deviation < 0.001


def test_iterate_is_equations_4_4_to_4_6() -> None:
    """Against the same in matrices."""
    numbers = np.random.default_rng(1)
    graph = Graph.of_shape("thesis-d", [f"r{i}" for i in range(6)])
    a = np.array(graph.matrix()) + np.eye(6)
    w = a / a.sum(1, keepdims=True)
    x, z, g, p = (numbers.normal(size=(6, 2)) for _ in range(4))
    phi, gamma = numbers.uniform(0.3, 2, 6), 0.03
    x_next = w @ x - z - gamma * g
    z_next = w @ z - gamma * g + gamma * w @ g
    g_next = 4 * (phi**2 - ((x_next - p) ** 2).sum(1))[:, None] * (p - x_next)
    nodes = [Node(tuple(x[i]), tuple(z[i]), tuple(g[i])) for i in range(6)]
    for i in range(6):
        weighted = [(w[i, j], nodes[j]) for j in range(6) if a[i, j]]
        new = iterate(nodes[i], weighted, gamma, phi[i], tuple(p[i]))
        assert new.x == pytest.approx(x_next[i])
        assert new.z == pytest.approx(z_next[i])
        assert new.g == pytest.approx(g_next[i])


# The guard


def limit(count: int = 3, shape: str = "line", scale: float = 1.0, start: Point = (0.0, 0.0)) -> float:
    names = [f"r{i}" for i in range(count)]
    places = {name: (scale * p[0], scale * p[1]) for name, p in zip(names, PLACES, strict=False)}
    target = (scale * TARGET[0], scale * TARGET[1])
    return guard.limit_step_size(Graph.of_shape(shape, names), places, target, start) * 1e-4


def test_the_limit_is_that_of_the_thesis() -> None:
    """7.3e-6 from (0, 0), 7.9e-6 from beside the target; the thesis found 7e-6 by trial."""
    assert limit() == pytest.approx(7.3e-6, rel=0.015)
    assert limit(start=(0.5, 0.99)) == pytest.approx(7.9e-6, rel=0.015)


def test_the_limit_goes_with_the_inverse_square_of_the_size() -> None:
    assert limit(scale=2.0) == pytest.approx(limit() / 4, rel=0.03)
    assert limit(scale=0.2) == pytest.approx(limit() * 25, rel=0.03)


@pytest.mark.parametrize("shape", ["line", "loop", "full", "thesis-d"])
def test_six_robots_have_a_lower_limit(shape: str) -> None:
    assert 2e-6 < limit(6, shape) < 6e-6


def test_below_the_limit_it_settles_above_it_the_app_says_that_it_diverges() -> None:
    gamma = limit() * 1e4

    def run(step_size: float) -> MemorySwarm:
        parameters = {"algorithm": "thesis", "step_size": step_size}
        return MemorySwarm("localization", config_of(3, "line", "localization", parameters), 200, exact)

    for result in run(0.97 * gamma).final.values():
        assert (result["x"], result["y"]) == pytest.approx(TARGET, abs=0.01)
    with pytest.raises(AppError, match=r"Thesis on r\d, iteration \d+: the estimate diverges: step_size"):
        run(1.1 * gamma)


def test_the_check_warns_near_the_limit_and_refuses_beyond() -> None:
    assert guard.check_step_size(0.04, 0.073) is None
    assert "may diverge" in str(guard.check_step_size(0.07, 0.073))
    with pytest.raises(AppError, match=r"0.08 1/m\^2 \(8e-06 1/cm\^2\) is above the limit .* 0.073 1/m\^2"):
        guard.check_step_size(0.08, 0.073)


def test_a_scene_where_nothing_converges_is_named() -> None:
    graph = Graph.of_shape("line", ["r0", "r1"])
    with pytest.raises(AppError, match="starts at the target"):
        guard.limit_step_size(graph, {"r0": (1.0, 0.0), "r1": (0.0, 1.0)}, (0.0, 0.0))
