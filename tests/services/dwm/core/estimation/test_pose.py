"""Which filter makes the pose, and what the pose says of itself."""

import math

import pytest

from services.dwm.core.calibration.models import Calibration, RangeModel
from services.dwm.core.estimation.pipeline import Pipeline
from services.dwm.core.estimation.tracker import SILENCE
from services.dwm.core.module.tlv import AnchorRange, Location, Position
from swarm.config.types import Affine, Anchor, Dwm

ANCHORS = (Anchor("D001", 0.0, 0.0), Anchor("D002", 1.94, 0.0), Anchor("D003", 1.0, 1.94))
SETTINGS = Dwm(window=3, latency=0.0)
MODELS = Calibration(RangeModel(0.9, -0.1), Affine(offset=(0.2, 0.0)))


def location(x, y, quality=90, anchors=ANCHORS, wobble=0.0):
    """Ranges that MODELS undo; the module's own place is off by 0.2 m in x."""
    known = Position(0.0, 0.0, 0.0, 100)
    ranges = tuple(
        AnchorRange(a.address, (math.dist((x, y), (a.x, a.y)) + 0.1) / 0.9 + wobble, 100, known) for a in anchors
    )
    return Location(Position(x - 0.2 + wobble, y, 0.0, quality), ranges)


def pipeline(kind, settings=SETTINGS):
    return Pipeline(settings, kind=kind, calibration=MODELS, anchors=ANCHORS)


def drive(line, seconds, speed=0.2, start=(0.5, 0.5), t=0.0):
    """Along x; odometry at 25 Hz and reports at 12.5 Hz. Gives the last pose, place and time."""
    x, y = start
    pose = None
    for i in range(round(seconds * 25)):
        t += 0.04
        x += speed * 0.04
        line.tracker.odometry(t, speed * 0.04, 0.0)
        if i % 2 == 0:
            _, pose = line.report(location(x, y, wobble=1e-4 * (i % 4)), t)
    return pose, (x, y), t


def test_average_of_the_modules_own_places():
    line = pipeline("average")
    for i, x in enumerate((1.0, 1.1, 1.2, 1.3)):
        _, pose = line.report(location(x, 1.0), i * 0.1)
    assert (pose.x, pose.y, pose.source, pose.quality) == (pytest.approx(1.2), pytest.approx(1.0), "average", 90)
    assert (pose.raw_x, pose.raw_y) == pytest.approx((1.1, 1.0))
    assert pose.deviation_x is None


def test_a_pose_follows_from_calibrated_ranges_by_multilateration():
    line = pipeline("multilateration", Dwm(window=1))
    _, pose = line.report(location(1.2, 0.7, quality=0), 0.0)
    assert (pose.x, pose.y) == pytest.approx((1.2, 0.7), abs=1e-4)
    assert pose.source == "multilateration"
    assert 0.02 < pose.deviation_x < 0.1
    assert 0 < pose.quality <= 100
    assert pose.raw_x is None
    _, pose = line.report(location(1.2, 0.7, anchors=ANCHORS[:2]), 0.1)
    assert (pose.quality, pose.deviation_x) == (0, None)


def test_the_kalman_filter_knows_heading_and_deviations():
    line = pipeline("ekf")
    pose, place, _ = drive(line, 6.0)
    assert (pose.x, pose.y) == pytest.approx(place, abs=0.02)
    assert pose.source == "ekf"
    assert pose.heading == pytest.approx(0.0, abs=0.1)
    assert 0.0 < pose.deviation_heading < 0.3
    assert 0.005 < pose.deviation_x < 0.1
    assert 0.005 < pose.deviation_y < 0.1
    assert -1 < pose.correlation < 1
    assert pose.quality > 50
    assert (pose.raw_x, pose.raw_y) == pytest.approx((place[0] - 0.2, place[1]), abs=0.02)


def test_a_pose_of_the_kalman_filter_is_for_now_although_the_module_repeats():
    line = pipeline("ekf")
    _, place, t = drive(line, 3.0)
    answer = location(*place)
    first, pose = line.report(answer, t + 0.01)
    line.tracker.odometry(t + 0.2, 0.1, 0.0)
    ranges, moved = line.report(answer, t + 0.2)
    assert ranges.sequence == first.sequence
    assert moved.t == t + 0.2
    assert moved.x == pytest.approx(pose.x + 0.1, abs=0.01)


def test_auto_is_the_average_until_there_is_odometry_and_when_it_ends():
    line = pipeline("auto")
    _, pose = line.report(location(1.0, 1.0), 0.0)
    assert pose.source == "average"
    pose, place, t = drive(line, 3.0)
    assert pose.source == "ekf"
    _, pose = line.report(location(*place), t + SILENCE + 0.1)
    assert pose.source == "average"


def test_ekf_without_odometry_has_no_fix():
    _, pose = pipeline("ekf").report(location(1.0, 1.0), 0.0)
    assert (pose.source, pose.quality) == ("ekf", 0)


def test_windows_of_places_and_ranges_are_apart():
    line = Pipeline(Dwm(window=1, position_window=4), kind="average", calibration=MODELS, anchors=ANCHORS)
    for i, x in enumerate((1.0, 1.1, 1.2, 1.3)):
        ranges, pose = line.report(location(x, 1.0), i * 0.1)
    assert pose.x == pytest.approx(1.15)
    assert ranges.ranges[0].distance == pytest.approx(math.hypot(1.3, 1.0))
