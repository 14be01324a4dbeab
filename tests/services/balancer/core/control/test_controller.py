"""Modes of the controller, fed with estimates made by hand; LEDs and lateness beside them."""

import math

import pytest
from balancer_rig import CONFIGURED
from hypothesis import given
from hypothesis import strategies as st

from services.balancer.core.control import controller as c
from services.balancer.core.control.choice import make_controller
from services.balancer.core.control.drive import TURN_LIMIT
from services.balancer.core.control.estimation.estimator import BodyEstimate
from services.balancer.core.control.manoeuvres import stand_up as su
from services.balancer.core.control.regulator import DUTY_LIMIT
from services.balancer.core.faults import FELL, STOPPED, MotorFault
from swarm.config.types import Balancing
from swarm.errors import LocalError

LYING = math.radians(110)


class Steps:
    """A controller and the time."""

    def __init__(self, trim: float = 0.0, **settings: object) -> None:
        self.controller = make_controller(CONFIGURED, trim, Balancing(**settings))
        self.now = 0.0

    def step(self, tilt: float = 0.0, *, rate: float = 0.0, way: float = 0.0, ticks: int = 1, **more: float):
        for _ in range(ticks):
            self.now += 0.01
            fields = dict.fromkeys(("speed", "heading", "turn_rate", "gyro_heading", "wheel_heading", "x", "y"), 0.0)
            fields |= {"left": way, "right": way} | more
            duties = self.controller.step(BodyEstimate(t=self.now, dt=0.01, tilt=tilt, tilt_rate=rate, **fields))
        return duties

    def balancing(self) -> "Steps":
        self.controller.command("stand", self.now)
        self.step(ticks=su.UPRIGHT_TICKS)
        assert self.controller.mode == "balancing"
        return self


def test_an_idle_controller_commands_no_power() -> None:
    steps = Steps()
    assert steps.step(0.3) == (0.0, 0.0)
    assert steps.controller.mode == "idle"


def test_held_upright_it_balances_after_a_moment() -> None:
    steps = Steps()
    steps.controller.command("stand", 0.0)
    steps.step(ticks=su.UPRIGHT_TICKS - 1)
    assert steps.controller.mode == "standing_up"
    steps.step()
    assert steps.controller.mode == "balancing"


def test_falling_forward_drives_forward() -> None:
    left, right = Steps().balancing().step(0.05)
    assert left == right > 0


def test_turned_to_the_left_it_turns_back() -> None:
    left, right = Steps().balancing().step(0.0, heading=0.2)
    assert left > right


def test_commands_stay_within_the_limit() -> None:
    left, right = Steps().balancing().step(0.9, rate=9.0, heading=2.0)
    assert left == DUTY_LIMIT + TURN_LIMIT
    assert right == DUTY_LIMIT - TURN_LIMIT


def test_fallen_is_a_fault_until_commanded() -> None:
    steps = Steps().balancing()
    steps.step(1.3, ticks=c.FALLEN_TICKS - 1)
    assert steps.controller.mode == "balancing"
    assert steps.step(1.3) == (0.0, 0.0)
    assert (steps.controller.mode, steps.controller.fault) == ("fault", MotorFault(FELL, "fell"))
    assert steps.step(0.0, ticks=100) == (0.0, 0.0)
    steps.controller.command("stand", steps.now)
    steps.step(0.0, ticks=su.UPRIGHT_TICKS)
    assert steps.controller.mode == "balancing"
    assert steps.controller.fault is None


def test_full_power_for_long_means_wheels_in_the_air() -> None:
    steps = Steps().balancing()
    steps.step(0.6, ticks=round(c.FULL_POWER_S * 100) - 2)
    assert steps.controller.mode == "balancing"
    steps.step(0.6, ticks=5)
    assert "wheels in the air" in steps.controller.fault.reason


def test_rest_makes_the_controller_idle_from_every_mode() -> None:
    for prepare in (
        lambda s: s.balancing(),
        lambda s: s.controller.command("stand", 0.0),
        lambda s: s.controller.fail(MotorFault(FELL, "x")),
    ):
        steps = Steps()
        prepare(steps)
        steps.controller.command("rest", steps.now)
        assert steps.step(0.1) == (0.0, 0.0)
        assert (steps.controller.mode, steps.controller.fault) == ("idle", None)


def test_the_first_reason_of_a_fault_stays() -> None:
    steps = Steps().balancing()
    assert steps.controller.fail(MotorFault(STOPPED, "enough"))
    assert not steps.controller.fail(MotorFault(FELL, "fell"))
    assert steps.controller.fault == MotorFault(STOPPED, "enough")


@pytest.mark.parametrize("mode", ["", "Stand", "balancing", "dance"])
def test_an_unknown_mode_is_refused(mode: str) -> None:
    steps = Steps().balancing()
    with pytest.raises(LocalError, match="expected one of stand, rest"):
        steps.controller.command(mode, steps.now)
    assert steps.controller.mode == "balancing"


def test_stand_again_while_balancing_changes_nothing() -> None:
    steps = Steps().balancing()
    before = steps.step(0.01, way=0.1)
    steps.controller.command("stand", steps.now)
    assert steps.controller.mode == "balancing"
    assert steps.step(0.01, way=0.1) != (0.0, 0.0) != before


@pytest.mark.parametrize("side", [1, -1])
def test_lying_still_it_runs_up_and_swings_to_its_other_side(side: int) -> None:
    steps = Steps()
    steps.controller.command("stand", 0.0)
    assert steps.step(side * LYING, ticks=round(su.LYING_S * 100) - 1) == (0.0, 0.0)
    duties = steps.step(side * LYING, ticks=4)
    assert duties == (-side * su.SWING_DUTIES[0],) * 2
    duties = steps.step(side * LYING, ticks=round(su.RUN_UP_S * 100))
    assert duties == (side * su.SWING_DUTIES[0],) * 2
    steps.step(side * 0.4, rate=-side * 6.0)
    assert steps.controller.mode == "balancing"


def test_standing_up_is_given_up_after_tries_of_growing_power() -> None:
    steps = Steps()
    steps.controller.command("stand", 0.0)
    strongest = []
    while steps.controller.mode == "standing_up":
        duty = abs(steps.step(LYING)[0])
        if duty and (not strongest or duty != strongest[-1]):
            strongest.append(duty)
    assert tuple(strongest) == su.SWING_DUTIES
    assert steps.controller.fault == MotorFault("cannot_stand", "cannot stand up: 3 tries failed")


@pytest.mark.parametrize("tilt", [math.pi, -math.radians(150), math.radians(60), 0.7])
def test_on_its_back_or_leaning_it_neither_stands_nor_swings(tilt: float) -> None:
    steps = Steps()
    steps.controller.command("stand", 0.0)
    for _ in range(round(su.PATIENCE_S * 100) + 5):
        assert steps.step(tilt) == (0.0, 0.0)
    assert "neither lies still nor is held upright" in steps.controller.fault.reason


def test_being_carried_is_not_lying() -> None:
    steps = Steps()
    steps.controller.command("stand", 0.0)
    for tick in range(500):
        assert steps.step(LYING, rate=0.5 * math.sin(tick / 5) if tick % 25 else 0.6) == (0.0, 0.0)


def test_a_fall_right_after_the_swing_is_a_failed_try() -> None:
    steps = Steps()
    steps.controller.command("stand", 0.0)
    steps.step(LYING, ticks=round((su.LYING_S + su.RUN_UP_S) * 100) + 4)
    steps.step(0.4)
    assert steps.controller.mode == "balancing"
    steps.step(-1.4, ticks=c.FALLEN_TICKS)
    assert steps.controller.mode == "standing_up"


def test_trim_is_learned_from_standing_beside_the_place() -> None:
    steps = Steps().balancing()
    first = steps.step(0.0, way=-0.05)[0]
    steps.step(0.0, way=-0.05, ticks=500)
    assert steps.step(0.0, way=-0.05)[0] < first  # leans further the other way


@given(st.lists(st.tuples(*[st.floats(allow_nan=True, allow_infinity=True)] * 4), min_size=1, max_size=20))
def test_no_estimate_makes_a_command_that_is_no_number(states) -> None:
    steps = Steps().balancing()
    for tilt, rate, way, speed in states:
        duties = steps.step(tilt, rate=rate, way=way, speed=speed)
        if not all(map(math.isfinite, (tilt, rate, way, speed))):
            assert steps.controller.mode == "fault"
        if steps.controller.mode == "fault":
            assert duties == (0.0, 0.0)
        assert all(abs(duty) <= DUTY_LIMIT + TURN_LIMIT for duty in duties)


def test_a_heading_that_is_no_number_is_a_fault() -> None:
    steps = Steps().balancing()
    assert steps.step(0.0, heading=math.nan) == (0.0, 0.0)
    assert steps.controller.mode == "fault"
