"""A target that moves, in both simulations: from the first iteration on, seen by modules, and told in the report."""

import math

import pytest

from bench.simulation import simulate as real
from services.sim.options import parse
from services.sim.virtual.run import simulate
from swarm.config.types import Simulation
from swarm.errors import ConfigError

MOVING = ("--target-velocity", "0.1,0.05")
SIX = ("localization", "--robots", "6", "--iterations", "300")


def test_it_stands_until_all_have_begun_and_goes_straight_on():
    simulation = Simulation(target=(0.5, 1.0), target_velocity=(0.1, -0.2))
    assert simulation.moving
    assert simulation.target_after(-math.inf) == simulation.target_after(0.0) == (0.5, 1.0)
    assert simulation.target_after(2.0) == pytest.approx((0.7, 0.6))
    assert not Simulation().moving


def test_it_is_followed_where_one_for_standing_targets_lags_behind():
    follows, outcome = simulate(*SIX, *MOVING, "--algorithm", "moving")
    moved = math.dist(outcome.targets()["r0"], (0.5, 1.0))
    assert moved == pytest.approx(math.hypot(0.1, 0.05) * follows["seconds"], abs=0.02)
    result = follows["result"]["r0"]
    assert (result["vx"], result["vy"]) == pytest.approx((0.1, 0.05), abs=0.04)
    lags, _ = simulate(*SIX, *MOVING, "--algorithm", "info")
    assert follows["error_cm"] < 3.0 < lags["error_cm"]


@pytest.mark.slow
def test_processes_follow_it_too():
    report = real("localization", "--iterations", "200", "--algorithm", "moving", *MOVING)
    assert report["problems"] == []
    assert report["error_cm"] < 8.0


@pytest.mark.parametrize("other", [("--noise", "none"), ("--replay", "somewhere"), ("--clock-skew", "20ppm")])
def test_what_it_cannot_be_with_is_said(other):
    with pytest.raises(ConfigError, match="--target-velocity"):
        parse(["localization", "--virtual", *MOVING, *other])
