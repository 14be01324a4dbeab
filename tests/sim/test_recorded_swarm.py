"""The original robots' measurements through the real processes (tests skip where the recordings are absent)."""

import os
from pathlib import Path

import pytest

from bench.rigs.simulation import simulate

DATA = Path(os.environ.get("SWARM_THESIS_DATA") or Path(__file__).parents[3] / "shared" / "thesis-data")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (DATA / "localization").is_dir(), reason=f"no recordings in {DATA}: set SWARM_THESIS_DATA to their folder"
    ),
]


@pytest.mark.parametrize(("run", "step"), [("test_2", "4e-6"), ("test_3", "4e-6"), ("test_5", "5e-7")])
def test_gradient_tracking_follows_the_recorded_trajectory(run, step):
    folder = str(DATA / "localization" / run)
    report = simulate(
        "localization", "--replay", folder, "--algorithm", "thesis", "--step-size", step, "--latency", "0ms"
    )
    assert report["iterations"] > 500
    assert report["replay_deviation_cm"] < 0.001
    assert report["error_cm"] == pytest.approx(report["recorded_error_cm"], abs=0.001)


def test_the_default_algorithm_reports_the_recorded_error_beside_its_own():
    report = simulate("localization", "--replay", str(DATA / "localization" / "test_3"), "--latency", "0ms")
    assert report["algorithm"] == "info"
    assert report["recorded_error_cm"] > 0
    assert report["error_cm"] < 10
    assert report["replay_deviation_cm"] < 10
