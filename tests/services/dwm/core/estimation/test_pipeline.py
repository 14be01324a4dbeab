import math
from dataclasses import replace

import pytest
from dwm_frames import LOCATION
from hypothesis import given
from hypothesis import strategies as st

from services.dwm.core.calibration import models as calibration
from services.dwm.core.estimation.motion import Increments
from services.dwm.core.estimation.pipeline import Pipeline
from services.dwm.core.module.ranges import FORGET, MAX_DISTANCE, MAX_MODULES, STALE, STUCK
from services.dwm.core.module.tlv import AnchorRange, Location, Position
from swarm.config.types import Affine, Anchor, Dwm, Linear
from swarm.messages import Odometry

DISTANCE = Linear(0.946976, -0.05964849)
POSITION = Affine(((0.93538932, 0.00353817), (-0.01071457, 0.94470965)), (0.046239576, 0.050861534))
PLAIN = Dwm(window=1)


def location(*distances, x=1.0, y=1.0, quality=100):
    known = Position(0.0, 0.0, 0.0, 100)
    ranges = tuple(AnchorRange(f"D00{index}", value, 90, known) for index, value in enumerate(distances))
    return Location(Position(x, y, 0.0, quality), ranges)


def test_the_distance_model_of_the_thesis():
    # eq. 2.8 undoes eq. 2.4, m = 1.056 d + 6.299 cm, within the digits of its constants
    model = calibration.RangeModel.of(DISTANCE)
    for true in (0.25, 0.5, 1.0, 1.5):
        assert model.distance(1.056 * true + 0.06299) == pytest.approx(true, abs=1e-4)
    assert model.distance(0.624) == pytest.approx(0.624 * 0.946976 - 0.05964849)
    assert model.distance(0.02) == 0.0


def test_the_position_model_of_the_thesis():
    x, y = calibration.position(POSITION, 0.439, 1.526)
    assert x == pytest.approx(0.93538932 * 0.439 + 0.00353817 * 1.526 + 0.046239576)
    assert y == pytest.approx(-0.01071457 * 0.439 + 0.94470965 * 1.526 + 0.050861534)


def test_all_ranges_are_published_with_both_values():
    ranges, pose = Pipeline(Dwm(window=1, distance=DISTANCE, position=POSITION)).report(LOCATION, 7.0)
    assert [item.anchor for item in ranges.ranges] == ["C933", "D001", "D002", "D003"]
    assert [item.quality for item in ranges.ranges] == [100, 99, 0, 50]
    assert ranges.ranges[0].raw == 1.0
    assert ranges.ranges[0].distance == pytest.approx(0.88732751)
    assert (ranges.t, ranges.sequence) == (7.0, 0)
    assert (pose.t, pose.sequence, pose.quality, pose.heading, pose.source) == (7.0, 0, 100, None, "module")
    assert (pose.x, pose.y) == pytest.approx(calibration.position(POSITION, 2.635, 1.055))


def test_a_repeat_is_no_new_sample():
    pipeline = Pipeline(Dwm(window=4))
    pipeline.report(location(1.0, 2.0), 1.0)
    ranges, pose = pipeline.report(location(2.0, 3.0, x=2.0), 1.1)
    again, same = pipeline.report(location(2.0, 3.0, x=2.0), 1.2)
    assert same == pose
    assert (again.t, again.sequence) == (1.2, ranges.sequence) == (1.2, 1)
    assert [item.age for item in again.ranges] == pytest.approx([0.1, 0.1])
    assert [replace(item, age=0.0) for item in again.ranges] == list(ranges.ranges)
    third, _ = pipeline.report(location(3.0, 4.0, x=2.0), 1.3)
    assert third.sequence == 2
    assert [item.distance for item in third.ranges] == pytest.approx([2.0, 3.0])  # the repeat did not count
    assert [item.age for item in third.ranges] == [0.0, 0.0]


def test_one_changed_number_makes_a_new_sample():
    pipeline = Pipeline(PLAIN)
    for index, report in enumerate([location(1.0, 2.0), location(1.0, 2.001), location(1.0, 2.001, x=1.001)]):
        assert pipeline.report(report, index * 0.1)[0].sequence == index


def test_an_anchor_that_was_missing_keeps_its_own_count():
    pipeline = Pipeline(PLAIN)
    pipeline.report(location(1.0, 2.0), 1.0)
    ranges, _ = pipeline.report(location(1.1), 1.1)
    assert {item.anchor: (item.sequence, item.raw, round(item.age, 6)) for item in ranges.ranges} == {
        "D000": (1, 1.1, 0.0),
        "D001": (0, 2.0, 0.1),
    }
    ranges, _ = pipeline.report(location(1.2, 2.2), 1.2)
    assert {item.anchor: item.sequence for item in ranges.ranges} == {"D000": 2, "D001": 1}


def test_a_lost_anchor_is_marked_and_then_left_out():
    pipeline = Pipeline(PLAIN)
    pipeline.report(location(1.0, 2.0), 0.0)
    stale = {}
    for step in range(1, 40):
        ranges, _ = pipeline.report(location(1.0 + step / 100), step / 10)
        stale[step / 10] = {item.anchor: item.stale for item in ranges.ranges}
    assert stale[0.5] == {"D000": False, "D001": False}
    assert stale[0.6] == {"D000": False, "D001": True}
    assert stale[FORGET] == {"D000": False, "D001": True}
    assert stale[FORGET + 0.1] == {"D000": False}
    ranges, _ = pipeline.report(location(1.0, 2.0), 4.0)
    assert {item.anchor: item.sequence for item in ranges.ranges} == {"D000": 40, "D001": 1}


def test_a_module_that_repeats_for_long_is_stale():
    """It thinks that it stands still, and measures every 10 s."""
    pipeline = Pipeline(PLAIN)
    pipeline.report(location(1.0), 0.0)
    ranges, _ = pipeline.report(location(1.0), 2.0)
    assert [(item.stale, item.age, item.sequence) for item in ranges.ranges] == [(True, 2.0, 0)]


def test_an_asking_at_a_low_rate_makes_nothing_stale():
    pipeline = Pipeline(Dwm(window=1, rate=1.0))
    pipeline.report(location(1.0), 0.0)
    assert [item.stale for item in pipeline.report(location(1.0), 2.0)[0].ranges] == [False]


def test_the_same_range_again_and_again_while_others_change_is_no_new_sample():
    pipeline = Pipeline(PLAIN)
    for step in range(STUCK + 8):
        ranges, _ = pipeline.report(location(1.0, 2.0 + step / 100), step / 10)
    stuck, moving = sorted(ranges.ranges, key=lambda item: item.anchor)
    assert (stuck.sequence, moving.sequence) == (STUCK - 1, STUCK + 7)
    assert (stuck.stale, moving.stale) == (True, False)
    assert stuck.age > STALE


def test_one_address_twice_and_impossible_distances_are_dropped_and_counted():
    pipeline = Pipeline(PLAIN)
    twice = replace(location(1.0, 2.0, 1.5).ranges[2], anchor="D000")
    answer = location(1.0, 2.0, MAX_DISTANCE + 0.001)
    ranges, _ = pipeline.report(replace(answer, ranges=(*answer.ranges, twice)), 0.0)
    assert [item.anchor for item in ranges.ranges] == ["D001"]
    assert pipeline.dropped() == {"duplicate_addresses": 2, "impossible_ranges": 1}


def test_ranges_to_robots_name_them():
    ranges, _ = Pipeline(PLAIN, {"D001": "r7"}).report(location(1.0, 2.0), 0.0)
    assert [item.robot for item in ranges.ranges] == [None, "r7"]


def test_without_a_fix_the_numbers_enter_nothing():
    pipeline = Pipeline(Dwm(window=5))
    _, pose = pipeline.report(location(1.0, quality=0, x=9.0), 1.0)
    assert (pose.quality, pose.x) == (0, 0.0)
    _, pose = pipeline.report(location(1.1, x=1.0), 1.1)
    assert (pose.quality, pose.x, pose.source) == (100, 1.0, "average")
    _, pose = pipeline.report(location(1.2, quality=0, x=9.0), 1.2)
    assert (pose.quality, pose.x, pose.sequence) == (0, 1.0, 2)
    _, pose = pipeline.report(location(1.3, x=2.0), 1.3)
    assert (pose.quality, pose.x) == (100, 1.5)


def test_an_average_starts_anew_after_a_gap():
    pipeline = Pipeline(Dwm(window=5))
    pipeline.report(location(1.0, x=1.0), 1.0)
    ranges, pose = pipeline.report(location(3.0, x=3.0), 1.1 + FORGET)
    assert (ranges.ranges[0].distance, pose.x) == (3.0, 3.0)


def test_wrong_addresses_do_not_pile_up():
    pipeline = Pipeline(PLAIN)
    known = Position(0.0, 0.0, 0.0, 100)
    for address in range(3 * MAX_MODULES):
        item = AnchorRange(f"{address:04X}", 1.0, 100, known)
        pipeline.report(Location(known, (item, AnchorRange("C933", address / 100, 100, known))), address * 0.01)
    ranges, _ = pipeline.report(Location(known, (AnchorRange("C933", 2.0, 100, known),)), 2.0)
    assert len(ranges.ranges) == MAX_MODULES
    assert {item.anchor: item.sequence for item in ranges.ranges}["C933"] == 3 * MAX_MODULES


def test_equal_reports_of_another_source_are_measurements_of_their_own():
    """A standing robot's ranges may be played from a file, or rounded."""
    pipeline = Pipeline(PLAIN, external=True)
    for number in range(20):
        ranges, _ = pipeline.report(location(1.0, 2.0), 0.1 * number)
        assert ranges.sequence == number
        assert [item.age for item in ranges.ranges] == [0.0, 0.0]


ANY = st.floats(-1e7, 1e7)
"""What a message of the balancer may hold."""
NEAR = st.floats(-1.0, 1.0)


@given(
    st.lists(
        st.tuples(st.sampled_from((0.01, 0.04, 1.0, 100.0)), NEAR | ANY, NEAR | ANY, NEAR | ANY, NEAR | ANY)
        | st.tuples(*[st.floats(0.0, 5.0) | st.floats(0.0, 1e7)] * 4, NEAR | ANY),
        max_size=60,
    ),
    st.booleans(),
)
def test_no_odometry_and_no_ranges_end_the_filter(events, moves):
    """Any program on the robot may publish what the balancer does."""
    anchors = [Anchor(f"D00{index}", float(index % 2), float(index // 2), 0.0) for index in range(4)]
    pipeline, increments = Pipeline(Dwm(window=1), kind="ekf", anchors=anchors), Increments()
    now, sequence = 100.0, 0
    for place, event in enumerate(events):
        now += 0.04
        if moves and place % 2:
            now += event[0]
            sequence += 1
            motion = increments.take(
                Odometry(now, sequence, event[1], event[2], 0.0, 0.0, 0.0, event[3], 0.0, event[4])
            )
            if motion is None:
                pipeline.tracker.begin(now)
            else:
                pipeline.tracker.odometry(*motion)
        else:
            _, pose = pipeline.report(location(*map(abs, event[:4]), x=event[4]), now)
            assert math.isfinite(pose.x + pose.y)
