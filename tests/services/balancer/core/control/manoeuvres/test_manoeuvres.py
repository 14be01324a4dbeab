"""Lying down, calibrating, and how the robot is told to lie or stand: in the simulated body."""

import math
import re
from pathlib import Path

import pytest
from balancer_rig import CONFIGURED, OTHER, PLANTS, Rig, upright
from conftest import thinned

from services.balancer.core.control.estimation import posture
from services.balancer.core.control.estimation.gyro import STILL_RANGE
from services.balancer.core.control.manoeuvres import lie_down
from sim.core.balboa import REST_TILT
from swarm.errors import LocalError

BODIES = pytest.mark.parametrize("plant", [CONFIGURED, OTHER], ids=["configured", "other"])


def touch_down_rate(rig: Rig) -> float:
    """How fast it turns just before it touches the floor, rad/s."""
    rates = [0.0]
    while rig.body.tilt < REST_TILT and len(rates) < 500:
        rates.append(rig.body.tilt_rate)
        rig.run(0.01)
    return max(rates[-3:])


@pytest.mark.parametrize("name", thinned(PLANTS))
def test_a_robot_lies_down_gently_and_ends_idle(name: str) -> None:
    page = (Path(__file__).parents[6] / "docs/reference/robot/balancer.md").read_text()
    claim = r"floor at (\S+) to (\S+) rad/s and ends within (\d+) cm. .* at (\d+) to (\d+) rad/s, with"
    figures = re.search(claim, page.replace("\n ", ""))
    assert figures is not None
    slowest, fastest, way_cm, slowest_off, fastest_off = map(float, figures.groups())

    gentle = upright(plant=PLANTS[name]).run(3)
    start = gentle.body.x, gentle.body.y
    gentle.balancer.command("lie", gentle.now)
    assert gentle.balancer.mode == "lying_down"
    soft = touch_down_rate(gentle)
    gentle.run(2)
    assert (gentle.balancer.mode, gentle.balancer.posture) == ("idle", "front")
    assert gentle.robot.atmega.motors == (0.0, 0.0)
    assert gentle.balancer.fault is None
    assert math.dist(start, (gentle.body.x, gentle.body.y)) <= way_cm / 100
    assert slowest <= soft <= fastest

    hard = upright(plant=PLANTS[name]).run(3)
    hard.balancer.command("rest", hard.now)
    hard.body.push(0.01)
    assert slowest_off <= touch_down_rate(hard) <= fastest_off


@BODIES
def test_from_lying_down_it_stands_up_again(plant) -> None:
    rig = upright(plant=plant).run(2)
    for _ in range(3):
        rig.balancer.command("lie", rig.now)
        rig.run(3)
        assert rig.balancer.mode == "idle"
        rig.balancer.command("stand", rig.now)
        rig.run(8)
        assert rig.balancer.mode == "balancing"


def test_a_robot_lies_down_while_it_drives() -> None:
    rig = upright().run(2)
    rig.balancer.drive(0.5, 1.0, 5.0, rig.now)
    rig.run(2)
    rig.balancer.command("lie", rig.now)
    rig.run(3)
    assert (rig.balancer.mode, rig.balancer.posture, rig.balancer.duty) == ("idle", "front", (0.0, 0.0))


@pytest.mark.parametrize("mode", ["lie", "calibrate"])
def test_what_cannot_be_done_now_is_refused_by_name(mode: str) -> None:
    rig = Rig(start_mode="rest").run(1) if mode == "calibrate" else Rig(start_mode="rest").run(4)
    with pytest.raises(LocalError, match=f"mode {mode}: "):
        rig.balancer.command(mode, rig.now)


def test_a_body_that_never_comes_down_has_its_motors_off_all_the_same() -> None:
    rig = upright().run(2)
    rig.balancer.command("lie", rig.now)
    rig.body.held = True
    rig.body.drive = lambda left, right: None
    rig.run(2 * lie_down.LONGEST_S + 0.1)
    assert (rig.balancer.mode, rig.balancer.duty) == ("idle", (0.0, 0.0))


def test_rest_ends_lying_down_at_once() -> None:
    rig = upright().run(2)
    rig.balancer.command("lie", rig.now)
    rig.run(0.1)
    rig.balancer.command("rest", rig.now)
    rig.run(0.02)
    assert (rig.balancer.mode, rig.balancer.duty) == ("idle", (0.0, 0.0))


@pytest.mark.parametrize(
    ("degrees", "name"),
    [(0, "upright"), (15, "upright"), (-40, "leaning"), (110, "front"), (-110, "back"), (180, "leaning")],
)
def test_posture_is_named_by_the_tilt(degrees: float, name: str) -> None:
    assert posture.posture(math.radians(degrees), 0.0) == name
    assert posture.posture(math.radians(degrees + 10), math.radians(10)) in (name, "leaning")


@pytest.mark.parametrize(("side", "name"), [(1, "front"), (-1, "back")])
def test_a_robot_on_its_back_does_not_count_as_standing(side: int, name: str) -> None:
    rig = Rig(start_mode="rest", tilt=side * REST_TILT, held=False).run(4)
    assert (rig.balancer.mode, rig.balancer.posture) == ("idle", name)
    rig.balancer.command("stand", rig.now)
    # Nothing of the way up is called balancing before it is upright.
    rig.run(10, until=lambda rig: rig.balancer.mode == "balancing")
    assert rig.balancer.mode == "balancing"
    assert abs(rig.body.tilt) < math.radians(35)
    assert rig.run(5).balancer.posture == "upright"


# Calibration of the gyro


def lying(**arguments) -> Rig:
    return Rig(start_mode="rest", tilt=REST_TILT, held=False, **arguments).run(4)


def test_calibration_finds_a_zero_that_has_drifted() -> None:
    rig = lying()
    errors = rig.robot.imu._errors
    rig.robot.imu._errors = errors._replace(gyro_offset=errors.gyro_offset + math.radians(0.5))
    rig.balancer.command("calibrate", rig.now)
    rig.run(0.5)
    assert rig.balancer.mode == "calibrating"
    rig.run(1)
    assert rig.balancer.mode == "idle"
    assert ("calibrate", "done") in rig.balancer.notices
    assert rig.balancer.estimate.tilt_rate == pytest.approx(0.0, abs=math.radians(0.3))
    assert rig.balancer._estimator.gyro_zero.pitch == pytest.approx(
        errors.gyro_offset + math.radians(0.5), abs=math.radians(0.03)
    )


def test_calibration_of_a_robot_that_moves_is_refused() -> None:
    rig = lying()
    rig.body.turn_rate = 5.0
    rig.run(0.02)
    with pytest.raises(LocalError, match="must be at rest, this one is moving"):
        rig.balancer.command("calibrate", rig.now)
    rig = upright().run(2)
    with pytest.raises(LocalError, match="must be idle, this one is balancing"):
        rig.balancer.command("calibrate", rig.now)


def test_calibration_is_given_up_when_the_robot_is_moved_meanwhile() -> None:
    rig = lying()
    before = rig.balancer._estimator.gyro_zero
    rig.balancer.command("calibrate", rig.now)
    rig.run(0.3)
    rig.body.turn_rate = 5 * STILL_RANGE
    rig.run(0.1)
    assert rig.balancer.mode == "idle"
    assert rig.balancer._estimator.gyro_zero == before
    assert rig.balancer.notices[-1][1].startswith("given up: the robot was moved")


def test_a_robot_that_is_moved_at_the_start_says_so_and_waits() -> None:
    rig = Rig()
    rig.robot.imu._errors = rig.robot.imu._errors._replace(gyro_noise=math.radians(20))
    rig.run(4)
    assert rig.balancer.mode == "calibrating"
    assert rig.balancer.notices[0] == ("calibrate", "the robot is moved: leave it alone for a second")
    rig.robot.imu._errors = rig.robot.imu._errors._replace(gyro_noise=math.radians(0.07))
    rig.run(3)
    assert rig.balancer.mode == "balancing"


def test_stand_during_a_calibration_gives_it_up() -> None:
    rig = lying()
    rig.balancer.command("calibrate", rig.now)
    rig.run(0.3)
    rig.balancer.command("stand", rig.now)
    rig.run(8)
    assert rig.balancer.mode == "balancing"
