"""Motors tried at low power, on a simulated robot that a hand holds; and the parts that may be mounted wrong."""

import math

import pytest
from balancer_rig import NO_OFFSETS, Rig, upright
from conftest import thinned
from hypothesis import given
from hypothesis import strategies as st

from services.balancer.core.control.manoeuvres.motor_trial import KINDS, LIMIT, LONGEST_S, check_test
from sim.core.actions import MISWIRINGS
from swarm.errors import LocalError
from swarm.messages import TryMotors


def lifted(tilt: float = 0.0) -> Rig:
    rig = Rig(start_mode="rest", tilt=-1.9, held=False, errors=NO_OFFSETS).run(3.0)
    rig.body.lift(tilt, 0.0)
    return rig.run(3.0)


def rolled(rig: Rig, **request: object) -> tuple[float, float]:
    """How far the wheels roll by the encoders, m, while a test runs and for a second after it."""
    wish = TryMotors(**{"left": 0.0, "right": 0.0, "seconds": 1.0, **request})
    before = rig.balancer.estimate
    rig.balancer.test_motors(wish, rig.now)
    rig.run(wish.seconds + 1.0)
    after = rig.balancer.estimate
    assert rig.balancer.mode == "idle"
    return after.left - before.left, after.right - before.right


def test_one_motor_turns_its_wheel_and_no_other_and_the_test_ends_by_itself() -> None:
    rig = lifted()
    left, right = rolled(rig, left=0.15)
    assert 0.05 < left < 0.3
    assert right == pytest.approx(0.0, abs=1e-3)
    assert rig.balancer.duty == (0.0, 0.0)


@pytest.mark.parametrize(("part", "sign"), [("right-motor", -1), ("right-encoder", -1), ("left-motor", 1)])
def test_a_reversed_part_shows_in_the_way_of_its_wheel(part: str, sign: int) -> None:
    rig = lifted()
    rig.robot.miswire(part, back=False)
    left, right = rolled(rig, right=0.15)
    assert sign * right > 0.05
    assert left == pytest.approx(0.0, abs=1e-3)
    rig.robot.miswire(part, back=True)
    assert rolled(rig, right=0.15)[1] > 0.05


def test_the_atmega_stops_motors_that_get_no_command() -> None:
    rig = lifted()
    whole, _ = rolled(rig, left=0.2, right=0.2, seconds=2.0)
    stopped, _ = rolled(rig, left=0.2, right=0.2, seconds=2.0, kind="watchdog")
    assert 0.02 < stopped < whole / 4


def test_wheels_follow_the_tilt_of_a_robot_in_the_hand_at_low_power() -> None:
    rig = lifted(math.radians(15))
    assert rolled(rig, seconds=2.0, kind="tilt")[0] > 0.05
    rig.body.lift(math.radians(-15), 0.0)
    assert rolled(rig.run(1.0), seconds=2.0, kind="tilt")[0] < -0.05


def test_a_wheel_turned_by_hand_and_a_body_that_is_turned_show_in_the_sensors() -> None:
    rig = lifted()
    before = rig.balancer.estimate
    rig.body.roll(0.0, math.tau)
    rig.run(2.0)
    assert rig.balancer.estimate.right - before.right == pytest.approx(math.tau * 0.04, rel=0.02)
    rig.body.lift(0.0, math.pi / 2)
    rig.run(2.0)
    assert rig.balancer.estimate.gyro_heading - before.gyro_heading == pytest.approx(math.pi / 2, abs=0.1)


def test_a_robot_that_balances_refuses_and_a_stop_ends_a_test() -> None:
    rig = lifted()
    rig.balancer.test_motors(TryMotors(0.1, 0.1, 5.0), rig.now)
    rig.run(0.1)
    assert rig.balancer.mode == "testing"
    assert rig.balancer.stop("test")
    rig.run(0.1)
    assert (rig.balancer.mode, rig.balancer.duty, rig.robot.atmega.motors) == ("fault", (0.0, 0.0), (0.0, 0.0))
    with pytest.raises(LocalError, match="swarm balance rest"):
        rig.balancer.test_motors(TryMotors(0.1, 0.1, 5.0), rig.now)
    standing = upright()
    with pytest.raises(LocalError, match="this one is balancing: swarm balance lie"):
        standing.balancer.test_motors(TryMotors(0.1, 0.1, 5.0), standing.now)


@given(st.floats(), st.floats(), st.floats(), st.sampled_from(KINDS) | st.text(max_size=30))
def test_no_test_of_motors_exceeds_the_limits(left: float, right: float, seconds: float, kind: str) -> None:
    try:
        check_test(TryMotors(left, right, seconds, kind))
    except LocalError:
        return
    assert abs(left) <= LIMIT
    assert abs(right) <= LIMIT
    assert 0.0 < seconds <= LONGEST_S
    assert kind in KINDS


@pytest.mark.parametrize("part", thinned(MISWIRINGS))
def test_a_part_that_was_put_right_is_as_before(part: str) -> None:
    one, other = lifted(0.3), lifted(0.3)
    other.robot.miswire(part, back=False)
    other.robot.miswire(part, back=True)
    assert one.run(0.5).balancer.estimate == other.run(0.5).balancer.estimate


@pytest.mark.parametrize(("command", "mode"), [("rest", "idle"), ("stand", "standing_up")])
def test_rest_and_stand_end_a_test_of_motors_and_no_other_mode_does(command: str, mode: str) -> None:
    rig = lifted()
    rig.balancer.test_motors(TryMotors(0.1, 0.1, 5.0), rig.now)
    rig.run(0.2)
    for refused in ("lie", "calibrate"):
        with pytest.raises(LocalError, match="this one is testing"):
            rig.balancer.command(refused, rig.now)
    assert rig.balancer.mode == "testing"
    rig.balancer.command(command, rig.now)
    assert rig.balancer.mode == mode
