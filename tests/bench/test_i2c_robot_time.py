"""The simulated bus takes the time that its bytes take, at any clock."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.rigs.timed_robot import TimedRobot
from services.balancer.core.control.body import body_model
from services.balancer.core.devices import balboa, imu
from sim.core.balboa import BalboaBody
from sim.core.devices import NO_ERRORS, SimulatedRobot
from sim.devices.i2c import SimulatedBus
from swarm.config.types import Body


class Timed:
    """A simulated bus on a clock that only transfers move."""

    def __init__(self, scl: float) -> None:
        self.now = 100.0
        body = BalboaBody(body_model("zero2w", Body()), self.now)
        robot = SimulatedRobot(body, random.Random(1), errors=NO_ERRORS)
        robot.scl = scl
        self.bus = SimulatedBus(robot, lambda: self.now, take=self._take)

    def _take(self, seconds: float) -> None:
        self.now += seconds


@given(st.floats(40e3, 400e3), st.integers(1, 12))
def test_a_transfer_takes_nine_clock_periods_a_byte_at_any_clock(scl: float, count: int) -> None:
    timed = Timed(scl)
    timed.bus.write_read(imu.ADDRESS, bytes((imu.OUTX_L_G,)), count)
    assert timed.now - 100.0 == pytest.approx((2 + 2 + 9 * (2 + 1 + count)) / scl)
    assert timed.bus.untimed() == 0.0, "what was taken is not counted as well"


def test_the_atmega_holds_the_clock_with_each_byte() -> None:
    timed = Timed(100e3)
    timed.bus.write(balboa.ADDRESS, bytes((balboa.ENCODERS,)))
    assert timed.now - 100.0 == pytest.approx(20 * 10e-6 + 2 * 25e-6)


@pytest.mark.parametrize(("scl", "step_ms"), [(100e3, 3.325), (62.5e3, 5.005), (40e3, 7.525)])
def test_a_control_step_takes_what_the_firmware_in_its_simulator_takes(scl: float, step_ms: float) -> None:
    """3.33, 5.01 and 7.53 ms through the real firmware."""
    robot = TimedRobot(scl=scl, cpu=0.0)
    robot.balancer.passenger = None  # nothing is read along
    robot.stand()
    robot.step_max = 0.0
    robot.run(1.0)
    assert robot.step_max == pytest.approx(step_ms * 1e-3, abs=1e-5)
    assert robot.balancer.mode == "balancing"


def test_computation_makes_a_tick_longer_by_what_it_takes() -> None:
    quick, slow = TimedRobot(scl=100e3, cpu=0.0), TimedRobot(scl=100e3, cpu=3e-3)
    for robot in (quick, slow):
        robot.run(0.02)
    assert slow.step_max - quick.step_max == pytest.approx(4 / 5 * 3e-3, abs=0.2e-3)
