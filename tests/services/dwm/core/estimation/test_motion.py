"""The Kalman filter in simulated motion; `./run bench localization` shows all of it."""

import math
import random

import pytest

from bench.dwm.localization import CONSISTENT, SCENARIOS, cost, nis, outside
from bench.dwm.motion import SEEDS, Outcome, errors, lag, rms, run
from services.dwm.core.estimation.ekf import GATE, Innovation


def judged(speed, hidden, limit, seeds):
    outcomes = [run(speed, hidden, seed) for seed in range(seeds)]
    found = {name: rms([error for one in outcomes for error in errors(one, name)]) for name in outcomes[0].paths}
    assert found["EKF"] <= limit
    assert all(found["EKF"] < other for name, other in found.items() if name != "EKF")
    assert outside(outcomes) < 0.05
    assert 0.7 < nis(outcomes) < 1.1
    if speed:
        assert lag(outcomes, "EKF") <= 0.08
        assert all(abs(error) < 0.15 for one in outcomes for t, error in one.headings if t > 10.0)
    return found


@pytest.mark.slow
def test_at_half_a_metre_a_second_averages_are_far_behind():
    found = judged(*SCENARIOS[2][1:], 3)
    assert found["IQR + MA15"] > 10 * found["EKF"]
    assert found["IQR + MA3"] > 5 * found["EKF"]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "speed", "hidden", "limit"), SCENARIOS)
def test_all_scenarios_with_all_seeds(name, speed, hidden, limit):
    judged(speed, hidden, limit, SEEDS)


def test_the_same_seed_gives_the_same_run():
    first, second = run(0.5, 0.05, 1), run(0.5, 0.05, 1)
    assert first.paths == second.paths
    assert math.isfinite(rms(errors(first, "EKF")))


def test_a_consistent_filter_has_the_mean_innovation_that_the_page_tells():
    generator = random.Random(1)
    drawn = [generator.gauss(0.0, 1.0) for _ in range(200_000)]
    innovations = [Innovation(0, error, 1.0, error * error <= GATE) for error in drawn]
    assert nis([Outcome(innovations=innovations)]) == pytest.approx(CONSISTENT, abs=0.01)


def test_what_a_period_costs_can_be_measured():
    seconds, held = cost(5)
    assert seconds > 0.0
    assert 0 < held < 100_000
