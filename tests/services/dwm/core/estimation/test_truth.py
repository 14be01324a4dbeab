"""Errors of poses and ranges against a truth that another source measures."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.dwm.core.estimation.truth import GAP_S, TruthComparison
from services.dwm.truth import key_of, lines_of
from swarm.messages import Pose, Range, Ranges

ANCHORS = {"D001": (0.0, 0.0, 0.3)}


def pose(sequence: int, t: float, x: float, y: float, quality: int = 90) -> Pose:
    return Pose(t, sequence, x, y, None, quality, "ekf")


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-1, 1))
def test_a_moving_robot_is_compared_with_where_it_was_at_the_time(dx: float, dy: float, speed: float) -> None:
    comparison = TruthComparison(ANCHORS)
    for k in range(30):
        comparison.truth(0.1 * k, 1.0 + speed * 0.1 * k, 0.5)
    for k in range(20):
        t = 0.23 + 0.1 * k
        x = 1.0 + speed * t
        comparison.pose(pose(k, t, x + dx, 0.5 + dy))
        distance = math.dist((x, 0.5, 0.0), ANCHORS["D001"]) + 0.04
        comparison.ranges(Ranges(t + 0.05, k, (Range("D001", distance, distance, 90, 0.05, k),)))
    found = comparison.result()
    assert found["pose"]["count"] == 20
    assert found["pose"]["rms_m"] == pytest.approx(math.hypot(dx, dy), abs=1e-4)
    assert found["pose"]["mean_m"] == pytest.approx([dx, dy], abs=1e-4)
    assert found["ranges"]["D001"]["mean_m"] == pytest.approx(0.04, abs=1e-4)
    assert found["ranges"]["D001"]["deviation_m"] == pytest.approx(0.0, abs=1e-4)
    assert "20 poses" in lines_of("r0", "sim/truth", found)[0]


def test_nothing_is_compared_where_the_truth_is_silent_or_the_pose_no_fix() -> None:
    comparison = TruthComparison(ANCHORS)
    assert "does the bridge run?" in lines_of("r0", "mocap/pose", comparison.result())[0]
    comparison.truth(0.0, 1.0, 1.0)
    comparison.truth(1.1 * GAP_S, 1.0, 1.0)
    comparison.truth(1.2 * GAP_S, 1.0, 1.0)
    comparison.pose(pose(1, 0.5 * GAP_S, 1.0, 1.0))
    comparison.pose(pose(2, 1.15 * GAP_S, 1.0, 1.0, quality=0))
    assert comparison.result()["pose"] is None


def test_a_key_is_a_whole_one_or_a_topic_of_the_robot() -> None:
    assert key_of("sim/truth", "r1") == "swarm/r1/sim/truth"
    assert key_of("swarm/{robot}/dwm/set/report", "r1") == "swarm/r1/dwm/set/report"
