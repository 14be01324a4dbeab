"""A target that moves: information that moves along, and what the swarm makes of it."""

import math
import random

import pytest
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st
from localization_rig import place
from memory_swarm import PLACES, MemorySwarm, config_of

from services.apps.builtin.localization import track
from swarm.messages import Measurement

PERIOD = 0.03
COORDINATE = st.floats(-1.5, 1.5)
VELOCITY = st.floats(-0.01, 0.01)


def target(k: int, speed: float) -> tuple[float, float]:
    return 0.5 + speed * PERIOD * k, 1.0 - 0.3 * speed * PERIOD * k


def seen(speed: float, noise: float):
    def measure(name: str, k: int) -> Measurement:
        numbers = random.Random(f"{name} {k}")
        here = PLACES[int(name[1:])]
        x, y = (c + 0.035 * noise * numbers.gauss(0, 1) for c in here)
        distance = math.dist(here, target(k, speed)) + 0.04 * noise * numbers.gauss(0, 1)
        return Measurement(PERIOD * k, k, distance, x, y)

    return measure


def run(algorithm: str, speed: float, noise: float, last: int = 120, measure=None) -> MemorySwarm:
    config = config_of(6, "line", "localization", {"algorithm": algorithm})
    return MemorySwarm("localization", config, last, measure or seen(speed, noise))


def rms(swarm: MemorySwarm, speed: float) -> float:
    """m, all robots, from iteration 60 on. State k has seen measurement k - 1 last."""
    errors = [
        math.dist(place(swarm, name, k), target(k - 1, speed)) ** 2 for name in swarm.results for k in range(60, 121)
    ]
    return math.sqrt(sum(errors) / len(errors))


def test_a_straight_line_is_followed_without_lag() -> None:
    swarm = run("moving", 0.3, 0.0)
    assert rms(swarm, 0.3) < 1e-3
    for result in swarm.final.values():
        assert (result["vx"], result["vy"]) == pytest.approx((0.3, -0.09), rel=0.01)
        assert not result["ambiguous"]


def test_with_noise_it_errs_a_centimetre_where_info_lags_by_ten() -> None:
    swarm = run("moving", 0.3, 1.0)
    assert rms(swarm, 0.3) < 0.016
    assert rms(run("info", 0.3, 1.0), 0.3) > 0.06
    for result in swarm.final.values():
        assert 0.008 < result["sigma"] < 0.016  # and so it is


def test_a_standing_target_is_found_as_well() -> None:
    assert rms(run("moving", 0.0, 1.0), 0.0) < 0.02


def test_the_sum_is_the_information_of_all_ranges() -> None:
    """Predict, then consensus: the swarm's sum is at every k that of one filter which is told everything."""
    swarm = run("moving", 0.2, 1.0, last=50)
    ox, oy = swarm.runners["r0"].app.origin()
    measure = seen(0.2, 1.0)
    central = track.NOTHING
    for k in range(51):
        if k != 1:  # state 0 and the first step have the same measurement
            central = track.predict(central, 1.0 - 1.0 / 40.0)
            for name in swarm.runners:
                m = measure(name, max(k - 1, 0))
                new = track.information(m.distance, m.x - ox, m.y - oy, math.hypot(0.04, 0.035))
                central = tuple(a + b for a, b in zip(central, new, strict=True))
        else:
            central = track.predict(central, 1.0 - 1.0 / 40.0)
        for i in range(track.LENGTH):
            total = math.fsum(states[k]["q"][i] for states in swarm.states.values())
            assert total == pytest.approx(central[i], rel=1e-9, abs=1e-7)


def test_a_repeated_measurement_says_nothing_new() -> None:
    once = seen(0.0, 1.0)

    def stuck(name: str, k: int) -> Measurement:
        return once(name, 0)

    swarm = run("moving", 0.0, 1.0, 10, stuck)
    # What was known is forgotten by a fortieth an iteration, and nothing has been added.
    weight = track.TRIANGLE.index((2, 2))
    total = [math.fsum(states[k]["q"][weight] for states in swarm.states.values()) for k in (0, 10)]
    assert total[1] == pytest.approx(total[0] * (1 - 1 / 40) ** 10)


def test_an_iteration_that_a_new_epoch_does_again_says_nothing_of_its_time() -> None:
    app = run("moving", 0.2, 1.0, 10).runners["r0"].app
    period, t = app._period, app._last[0]
    app._last = t - 1.0, app.k
    app._measure_period()
    assert app._period == period
    assert app._last == (t, app.k)


@costly(60)
@given(st.lists(st.tuples(COORDINATE, COORDINATE), min_size=5, max_size=6, unique=True), COORDINATE, COORDINATE,
       VELOCITY, VELOCITY)  # fmt: skip
def test_information_of_exact_ranges_is_least_cost_at_the_truth(
    places: list[tuple[float, float]], x: float, y: float, vx: float, vy: float
) -> None:
    """Twenty iterations of a straight line: the cost's slope vanishes where the target is, with the velocity it has."""
    information = track.NOTHING
    for k in range(20):
        at = (x + vx * (k - 19), y + vy * (k - 19))
        information = track.predict(information, 0.9)
        for p in places:
            new = track.information(math.dist(p, at), *p, 0.05)
            information = tuple(a + b for a, b in zip(information, new, strict=True))
    full = track._full(x, y, vx, vy)
    matrix = [[0.0] * track.SIZE for _ in range(track.SIZE)]
    for (i, j), value in zip(track.TRIANGLE, information, strict=False):
        matrix[i][j] = matrix[j][i] = value
    largest = max(map(abs, information))
    for row, v in zip(matrix, information[len(track.TRIANGLE) :], strict=True):
        assert sum(m * f for m, f in zip(row, full, strict=True)) == pytest.approx(v, abs=1e-9 * largest)


def test_nothing_measured_gives_nothing() -> None:
    assert track.solve(track.NOTHING, 3, 0.01, (0.0, 0.0)) is None
