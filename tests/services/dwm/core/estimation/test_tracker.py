import math
import random

import pytest

from services.dwm.core.estimation.motion import KEPT, DeadReckoning, Increments
from services.dwm.core.estimation.tracker import LATENCY, SILENCE, START_REPORTS, Tracker
from swarm.messages import Odometry

ANCHORS = {"D001": (0.0, 0.0, 0.0), "D002": (1.94, 0.0, 0.0), "D003": (1.0, 1.94, 0.0), "C933": (0.5, 1.0, 0.0)}


class Robot:
    """Drives, sends odometry at 25 Hz and late ranges at 10 Hz."""

    def __init__(self, tracker, x=1.0, y=0.5, heading=1.0, noise=0.0, seed=1, lever=0.0, anchors=ANCHORS):
        self.tracker, self.x, self.y, self.heading, self.t = tracker, x, y, heading, 0.0
        self.generator, self.noise, self.lever, self.anchors = random.Random(seed), noise, lever, anchors
        self.past = [(self.t, x, y)]
        self.tilt = 0.0
        self.told = []
        tracker.odometry(0.0, 0.0, 0.0)

    def drive(self, seconds, speed=0.2, rate=0.6):
        step = 0.02
        for i in range(1, round(seconds / step) + 1):
            self.heading += rate * step
            self.x += speed * step * math.cos(self.heading - rate * step / 2)
            self.y += speed * step * math.sin(self.heading - rate * step / 2)
            self.t += step
            lean = self.lever * math.sin(self.tilt)
            self.past.append((self.t, self.x + lean * math.cos(self.heading), self.y + lean * math.sin(self.heading)))
            if i % 2 == 0:
                self.tracker.odometry(self.t, 2 * speed * step, 2 * rate * step, self.tilt)
            if i % 5 == 0:
                self.told += self.tracker.ranges(self.t, self.ranges())

    def ranges(self):
        _, x, y = self.past[max(0, len(self.past) - 1 - round(LATENCY / 0.02))]
        return [
            (name, math.dist((x, y, 0.0), place) + self.generator.gauss(0, self.noise))
            for name, place in self.anchors.items()
        ]

    def error(self):
        estimate = self.tracker.estimate(self.t)
        return math.hypot(estimate.x - self.x, estimate.y - self.y)

    def heading_error(self):
        heading = self.tracker.estimate(self.t).heading
        return abs((heading - self.heading + math.pi) % (2 * math.pi) - math.pi)


@pytest.mark.parametrize("heading", [0.0, 1.0, 2.0, 3.0, -1.0, -2.0])
def test_finds_place_and_heading_by_driving_a_little(heading):
    robot = Robot(Tracker(ANCHORS), heading=heading, noise=0.02)
    robot.drive(1.0, speed=0.0, rate=0.0)
    estimate = robot.tracker.estimate(robot.t)
    assert estimate.heading is None
    assert robot.error() < 0.05
    robot.drive(5.0)
    assert robot.error() < 0.03
    assert robot.heading_error() < 0.1
    deviation = robot.tracker.estimate(robot.t).heading_deviation
    assert 0.01 < deviation < 0.15
    assert robot.tracker.restarts == 0


def test_late_ranges_do_not_hold_a_fast_robot_back():
    robot = Robot(Tracker(ANCHORS), x=1.0, y=0.6)
    robot.drive(12.0, speed=0.5, rate=1.2)
    assert robot.error() < 0.012
    late = Tracker(ANCHORS, latency=0.0)
    robot = Robot(late, x=1.0, y=0.6)
    robot.drive(12.0, speed=0.5, rate=1.2)
    assert robot.error() > 0.02  # so the compensation is what does it


def test_the_estimate_is_for_the_moment_asked_for():
    robot = Robot(Tracker(ANCHORS))
    robot.drive(10.0, speed=0.4, rate=1.0)
    now, soon = robot.tracker.estimate(robot.t), robot.tracker.estimate(robot.t + 0.04)
    assert math.hypot(soon.x - now.x, soon.y - now.y) == pytest.approx(0.016, abs=0.002)
    assert soon.heading - now.heading == pytest.approx(0.04, abs=0.002)


def test_a_leaning_robot_has_its_antenna_ahead():
    tracker = Tracker(ANCHORS, lever=0.15)
    robot = Robot(tracker, lever=0.15)
    robot.drive(6.0)
    robot.tilt = 0.3
    robot.drive(4.0)
    assert robot.error() < 0.01


def test_an_antenna_that_is_not_isotropic():
    tracker = Tracker(ANCHORS, antenna=(0.05, 0.0))
    robot = Robot(tracker)
    exact = robot.ranges
    robot.ranges = lambda: [(name, distance + 0.05 * math.cos(robot.heading)) for name, distance in exact()]
    robot.drive(15.0)
    assert robot.error() < 0.02


def test_a_robot_that_is_carried_away_is_found_again():
    robot = Robot(Tracker(ANCHORS), noise=0.03)
    robot.drive(5.0)
    robot.x, robot.y, robot.heading = robot.x - 0.6, robot.y + 0.8, robot.heading + 2.0
    robot.drive(8.0)
    assert robot.tracker.restarts == 1
    assert robot.error() < 0.05
    assert robot.heading_error() < 0.2


def test_one_blocked_anchor_of_four_does_no_harm():
    robot = Robot(Tracker(ANCHORS), noise=0.03)
    robot.drive(5.0)
    exact = robot.ranges
    robot.ranges = lambda: [(name, distance + 0.6 * (name == "D002")) for name, distance in exact()]
    robot.drive(10.0)
    assert robot.error() < 0.06
    assert robot.tracker.restarts == 0


def test_what_is_missing_is_said():
    tracker = Tracker(ANCHORS)
    assert tracker.ranges(1.0, [("D001", 1.0)]) == []
    assert tracker.problem == "no odometry"
    assert not tracker.has_odometry(1.0)
    tracker.odometry(1.0, 0.0, 0.0)
    tracker.ranges(1.1, [("FFFF", 1.0)])
    assert tracker.problem == "no range to a configured anchor"
    tracker.ranges(1.2, [("D001", 1.0), ("D002", 1.0)])
    assert tracker.problem == "2 ranges, three are needed"
    assert tracker.estimate(1.2) is None
    for report in range(START_REPORTS - 1):  # the one of 1.2 counts, too
        assert report == 0 or tracker.problem == "the first ranges are being compared"
        tracker.ranges(1.3 + 0.1 * report, [(name, 1.0) for name in ANCHORS])
    assert tracker.problem == ""
    assert tracker.estimate(1.3) is not None
    assert tracker.has_odometry(1.0 + SILENCE)
    assert not tracker.has_odometry(1.01 + SILENCE)


def test_odometry_from_the_past_is_left_out():
    tracker = Tracker(ANCHORS)
    robot = Robot(tracker)
    robot.drive(3.0)
    before = tracker.estimate(robot.t)
    tracker.odometry(robot.t - 1.0, 5.0, 1.0)
    assert tracker.estimate(robot.t) == before


def test_track_gives_the_robot_at_any_time():
    motion = DeadReckoning(10.0)
    for i in range(1, 6):
        motion.add(10.0 + 0.04 * i, 0.02, 0.0, 0.1 * i)
    node = motion.at(10.10)
    assert (node.u, node.v, node.tilt) == pytest.approx((0.05, 0.0, 0.25))
    assert motion.at(9.0).u == 0.0
    assert motion.at(10.22).u == pytest.approx(0.11)  # on at the last speed
    assert motion.at(99.0).u == pytest.approx(0.15)  # not for long
    for i in range(1, 100):
        motion.add(10.2 + 0.04 * i, 0.0, 0.0, 0.0)
    assert motion.newest.t - motion._nodes[0].t <= KEPT + 0.04 + 1e-9


def odometry(t, sequence, rolled, heading):
    return Odometry(t, sequence, rolled - 0.01, rolled + 0.01, 0.0, 0.0, 0.0, heading, 0.0, 0.1)


def test_increments_follow_from_sums_of_odometry() -> None:
    increments = Increments()
    assert increments.take(odometry(1.0, 10, 5.0, 2.0)) is None
    assert increments.take(odometry(1.1, 13, 5.2, 2.1)) == pytest.approx((1.1, 0.2, 0.1, 0.1))  # two were lost
    assert increments.take(odometry(1.1, 13, 5.2, 2.1)) == (1.1, 0.0, 0.0, 0.1)  # it has come twice
    assert increments.take(odometry(1.2, 1, 0.0, 0.0)) is None  # the balancer began anew
    assert increments.take(odometry(1.3, 2, -0.1, 0.3)) == pytest.approx((1.3, -0.1, 0.3, 0.1))


@pytest.mark.parametrize("late", range(START_REPORTS))
def test_a_detour_in_one_of_the_first_reports_does_not_put_it_behind_the_anchors(late: int) -> None:
    """With three anchors a range that is 0.7 m too long fits the mirror image beyond two of them."""
    anchors = {name: ANCHORS[name] for name in ("D001", "D002", "D003")}
    place = (1.48, 0.36, 0.0)
    tracker = Tracker(anchors)
    tracker.odometry(0.0, 0.0, 0.0)
    for report in range(START_REPORTS):
        ranges = [(name, math.dist(place, anchor)) for name, anchor in anchors.items()]
        if report == late:
            ranges[2] = ("D003", ranges[2][1] + 0.7)
        tracker.odometry(0.1 * (report + 1), 0.0, 0.0)
        tracker.ranges(0.1 * (report + 1), ranges)
    estimate = tracker.estimate(0.5)
    assert math.dist((estimate.x, estimate.y), place[:2]) < 0.05


def test_after_a_restart_of_the_balancer_the_pose_is_found_anew() -> None:
    """Somebody may have turned the robot meanwhile."""
    tracker = Tracker(ANCHORS)
    robot = Robot(tracker)
    robot.drive(6.0)
    assert math.cos(tracker.estimate(robot.t).heading - robot.heading) > 0.95
    robot.heading += math.pi / 2
    tracker.begin(robot.t)
    assert tracker.estimate(robot.t) is None
    robot.drive(6.0)
    assert math.cos(tracker.estimate(robot.t).heading - robot.heading) > 0.95
    assert tracker.restarts == 0
