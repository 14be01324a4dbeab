"""nids, diging and flood: where they end, what they keep, and what they say of their place."""

import math
import random
import statistics

import pytest
from conftest import thinned
from hypothesis import given
from hypothesis import strategies as st
from localization_rig import exact, noisy, place, rounds_to
from memory_swarm import PLACES, TARGET, MemorySwarm, config_of

from services.apps.builtin.localization import flood, ranges
from services.apps.builtin.localization.leastsquares import refine
from swarm.errors import AppError
from swarm.messages import Measurement

GRAPHS = [(3, "line"), (6, "line"), (6, "loop"), (6, "thesis-d"), (6, "full")]
ALGORITHMS = ("info", "nids", "flood", "diging", "thesis")


def run(algorithm: str, count: int, shape: str, last: int, measure=exact, *, every=False, **parameters) -> MemorySwarm:
    config = config_of(count, shape, "localization", {"algorithm": algorithm, **parameters})
    return MemorySwarm("localization", config, last, measure, every=every)


def frozen(seed: int):
    return lambda name, k: noisy(name, seed)


def least_squares(count: int, seed: int) -> tuple[float, float]:
    seen = [noisy(f"r{i}", seed) for i in range(count)]
    return refine([(m.distance, m.x, m.y) for m in seen], TARGET)


@pytest.mark.parametrize(
    ("algorithm", "rounds"),
    [
        ("info", (2, 2, 1, 1, 1)),
        ("nids", (27, 39, 24, 22, 17)),
        ("flood", (2, 2, 1, 1, 1)),
        ("diging", (81, 62, 61, 59, 60)),
    ],
)
def test_rounds_to_a_centimetre_on_exact_ranges(algorithm: str, rounds: tuple[int, ...]) -> None:
    for (count, shape), most in zip(GRAPHS, rounds, strict=True):
        assert rounds_to(run(algorithm, count, shape, 90, every=True), TARGET) <= most


@pytest.mark.parametrize(("count", "shape"), GRAPHS)
@pytest.mark.parametrize("seed", thinned(range(3)))
def test_nids_ends_on_the_least_squares_of_all_ranges(count: int, shape: str, seed: int) -> None:
    swarm = run("nids", count, shape, 250, frozen(seed))
    for name in swarm.results:
        assert place(swarm, name, -1) == pytest.approx(least_squares(count, seed), abs=1e-5)


@pytest.mark.parametrize(("count", "shape"), GRAPHS)
def test_flood_is_the_least_squares_of_all_ranges_after_as_many_rounds_as_hops(count: int, shape: str) -> None:
    swarm = run("flood", count, shape, 5, frozen(1))
    for name in swarm.results:
        assert place(swarm, name, -1) == pytest.approx(least_squares(count, 1), abs=1e-3)  # sent in mm


def test_flood_knows_nothing_older_than_the_way_is_long() -> None:
    """Range and place of the first robot of a line, as the last one has it: five iterations late."""

    def counting(name: str, k: int) -> Measurement:
        return Measurement(0.0, k, 0.5 + 0.01 * k, *PLACES[int(name[1:])])

    swarm = run("flood", 6, "line", 20, counting, smoothing=1)
    entry = swarm.states["r5"][20]["entries"][0]
    # The step from k to k + 1 takes measurement k.
    assert flood.unpack(entry)[0] == pytest.approx(0.5 + 0.01 * (20 - 5 - 1), abs=1e-3)


@given(st.floats(0, 130), st.floats(-65, 65), st.floats(-65, 65))
def test_an_entry_holds_a_range_and_a_place_to_the_millimetre(distance: float, x: float, y: float) -> None:
    entry = flood.pack(distance, x, y)
    assert entry != 0.0
    assert entry == float(int(entry)) < 2**53
    assert flood.unpack(entry) == pytest.approx((distance, x, y), abs=0.5001e-3)


def test_what_no_entry_can_hold_is_clipped() -> None:
    assert flood.unpack(flood.pack(500.0, 500.0, -500.0)) == pytest.approx((131.071, 65.535, -65.536))


def test_flood_says_how_many_robots_it_has_room_for() -> None:
    def somewhere(name: str, k: int) -> Measurement:
        return Measurement(0.0, k, 1.0, 1.0, 1.0)

    run("flood", flood.ROOM, "loop", 1, somewhere)
    with pytest.raises(AppError, match="room for 54 robots, the swarm has 55"):
        run("flood", flood.ROOM + 1, "loop", 1, somewhere)


def test_diging_keeps_the_sum_of_the_gradients() -> None:
    """What is sent is rounded to float32; the sum of the trackers is that of the gradients all the same."""
    swarm = run("diging", 6, "thesis-d", 400, noisy)
    apps = [runner.app for runner in swarm.runners.values()]
    for i in range(2):
        gradients = math.fsum(app._g[i] for app in apps)
        assert math.fsum(app._y[i] for app in apps) == pytest.approx(gradients, abs=1e-11)


@pytest.mark.parametrize(("count", "shape"), thinned([(6, "line"), (6, "thesis-d")]))
def test_diging_ends_where_the_squared_ranges_say_whatever_the_graph(count: int, shape: str) -> None:
    """The thesis' row weights pull the answer to where links are many; symmetric ones do not."""
    swarm = run("diging", count, shape, 900, frozen(2))
    ends = {place(swarm, name, -1) for name in swarm.results}
    seen = [noisy(f"r{i}", 2) for i in range(count)]

    def cost(x: float, y: float) -> float:
        return math.fsum((m.distance**2 - math.dist((x, y), (m.x, m.y)) ** 2) ** 2 for m in seen)

    for x, y in ends:
        assert (x, y) == pytest.approx(next(iter(ends)), abs=1e-5)
        for dx, dy in ((1e-3, 0), (-1e-3, 0), (0, 1e-3), (0, -1e-3)):
            assert cost(x, y) < cost(x + dx, y + dy)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_tells_the_same_uncertainty(algorithm: str) -> None:
    parameters = {"step_size": 0.02} if algorithm in ("thesis", "diging") else {}
    swarm = run(algorithm, 6, "loop", 400, frozen(1), **parameters)
    parts = [
        ranges.statistics(m.distance, m.x, m.y, math.hypot(0.04, 0.035)) for m in map(frozen(1), swarm.results, [0] * 6)
    ]
    mean = tuple(statistics.fmean(column) for column in zip(*parts, strict=True))
    best = ranges.solve(mean, 6)
    assert best is not None
    for result in swarm.final.values():
        assert (result["var_x"], result["cov_xy"], result["var_y"]) == pytest.approx(
            best.covariance, rel=0.02, abs=2e-6
        )
        assert result["sigma"] == pytest.approx(best.sigma, rel=0.01)
        assert result["rank"] == 3
        assert not result["ambiguous"]


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_tells_that_two_places_fit(algorithm: str) -> None:
    parameters = {"step_size": 0.02} if algorithm in ("thesis", "diging") else {}
    swarm = run(algorithm, 2, "line", 400, exact, **parameters)
    mirror = (0.9, 1.2)
    for result in swarm.final.values():
        assert result["ambiguous"]
        assert result["rank"] == 2
        found = sorted([(result["x"], result["y"]), (result["other_x"], result["other_y"])])
        assert found == [pytest.approx(TARGET, abs=0.01), pytest.approx(mirror, abs=0.01)]


@pytest.mark.parametrize("algorithm", thinned(ALGORITHMS))
def test_noise_that_goes_on_leaves_no_bias(algorithm: str) -> None:
    parameters = {"step_size": 0.01} if algorithm in ("thesis", "diging") else {}
    swarm = run(algorithm, 3, "line", 700, noisy, every=True, **parameters)
    late = [(r["x"], r["y"]) for results in swarm.results.values() for r in results[200:]]
    middle = statistics.fmean(x for x, _ in late), statistics.fmean(y for _, y in late)
    assert math.dist(middle, TARGET) < 0.015


def test_refining_never_makes_it_worse() -> None:
    numbers = random.Random(3)
    for _ in range(200):
        angles = [numbers.uniform(-math.pi, math.pi) for _ in range(4)]
        places = [(math.cos(angle), math.sin(angle)) for angle in angles]
        seen = [(math.hypot(x, y) + numbers.gauss(0, 0.05), x, y) for x, y in places]
        start = (numbers.uniform(-0.1, 0.1), numbers.uniform(-0.1, 0.1))

        def cost(at: tuple[float, float], seen=seen) -> float:
            return math.fsum((math.dist(at, (x, y)) - d) ** 2 for d, x, y in seen)

        end = refine(seen, start)
        assert cost(end) <= cost(start)
        for dx, dy in ((1e-4, 0), (-1e-4, 0), (0, 1e-4), (0, -1e-4)):
            assert cost(end) <= cost((end[0] + dx, end[1] + dy)) + 1e-12
