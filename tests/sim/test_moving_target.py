"""A target that moves, in both simulations: from the first iteration on, seen by modules, and told in the report."""

import math
import statistics

import pytest

from bench.rigs.simulation import Simulation
from sim.scenario.options import parse
from sim.virtual.run import run_virtually
from swarm.config.types import SimulationConfig as World
from swarm.errors import ConfigError
from swarm.recording.reader import SUFFIX, RecordingReader
from swarm.recording.trajectory import is_state

MOVING = ("--target-velocity", "0.1,0.05")
SIX = ("localization", "--robots", "6", "--iterations", "300")


def test_a_moving_target_stands_until_all_have_begun_and_then_goes_straight_on():
    simulation = World(target=(0.5, 1.0), target_velocity=(0.1, -0.2))
    assert simulation.moving
    assert simulation.target_after(-math.inf) == simulation.target_after(0.0) == (0.5, 1.0)
    assert simulation.target_after(2.0) == pytest.approx((0.7, 0.6))
    assert not World().moving


@pytest.mark.slow
def test_the_algorithm_moving_follows_a_target_behind_which_info_lags():
    follows, outcome = run_virtually(*SIX, *MOVING, "--algorithm", "moving")
    moved = math.dist(outcome.targets()["r0"], (0.5, 1.0))
    assert moved == pytest.approx(math.hypot(0.1, 0.05) * follows["seconds"], abs=0.02)
    result = follows["result"]["r0"]
    assert (result["vx"], result["vy"]) == pytest.approx((0.1, 0.05), abs=0.04)
    lags, _ = run_virtually(*SIX, *MOVING, "--algorithm", "info")
    assert follows["error_cm"] < 3.0 < lags["error_cm"]


@pytest.mark.slow
def test_real_processes_follow_a_moving_target_too():
    """Judged are its way and its velocity: how far behind estimates are depends on how old a busy machine lets
    measurements become, which the virtual run above does not."""
    with Simulation("localization", "--iterations", "200", "--algorithm", "moving", *MOVING) as simulation:
        report = simulation.finish()
        samples = RecordingReader(simulation.records / f"r0.localization{SUFFIX}").samples()
        results = [sample.message["result"] for sample in samples if is_state(sample.topic)][100:]
    assert report["problems"] == []
    beside = [abs((each["x"] - 0.5) * 0.05 - (each["y"] - 1.0) * 0.1) / math.hypot(0.1, 0.05) for each in results]
    assert statistics.median(beside) < 0.08
    velocity = [statistics.median(each[name] for each in results) for name in ("vx", "vy")]
    assert velocity == pytest.approx([0.1, 0.05], abs=0.05)


@pytest.mark.parametrize("other", [("--noise", "none"), ("--replay", "somewhere"), ("--clock-skew", "20ppm")])
def test_what_it_cannot_be_with_is_said(other):
    with pytest.raises(ConfigError, match="--target-velocity"):
        parse(["localization", "--virtual", *MOVING, *other])
