"""Transfers that fail, and a bus that is stuck: what is tried again, what frees it, and that the robot stays up."""

import errno
import random

import pytest
from balancer_rig import Rig, upright

from services.balancer.balancer import LEDS_AGAIN_S
from services.balancer.core.devices import balboa, imu
from services.balancer.device_drivers import Balboa, Imu
from services.balancer.slack_tasks import SlackTasks

KINDS = (errno.EREMOTEIO, errno.ETIMEDOUT, errno.EIO)


def drivers(rig: Rig) -> tuple[Imu, Balboa]:
    return rig.balancer.imu, rig.balancer.balboa


@pytest.mark.parametrize("code", [errno.EREMOTEIO, errno.EIO])
@pytest.mark.parametrize("place", range(4))
def test_a_transfer_of_the_control_step_is_done_again_at_once(code: int, place: int) -> None:
    """Select, IMU, encoders, motors: whichever of the four failed, the tick goes on."""
    rig = upright().run(1.0)
    duty, ticks = rig.balancer.duty, rig.tick
    # The IMU's burst is a write and a read of the simulated robot, each with a failure of its own.
    rig.robot.failures = [0] * (place + (place > 1)) + [code]
    rig.run(0.01)
    assert rig.tick == ticks + 1
    assert rig.robot.failures == []
    assert rig.balancer.bus_errors == 1
    assert rig.balancer.estimate.t == pytest.approx(rig.deadline - 0.01)
    assert rig.balancer.duty != duty
    assert rig.robot.atmega.motors == pytest.approx(rig.balancer.duty, abs=0.002)


def test_after_a_failed_read_the_index_is_set_anew() -> None:
    """It may stand anywhere: the second try must not read from there."""
    rig = upright().run(1.0)
    _, driver = drivers(rig)
    driver.select(balboa.ENCODERS)
    rig.robot.atmega.read(3, rig.now)
    rig.robot.failures = [errno.EIO]
    again = driver.fetch_motion()
    driver.select(balboa.ENCODERS)
    assert driver.fetch_motion() == again


def test_a_time_out_is_not_tried_again_in_the_same_tick() -> None:
    rig = upright().run(1.0)
    rig.robot.failures = [errno.ETIMEDOUT]
    duty = rig.balancer.duty
    rig.run(0.01)
    assert rig.balancer.duty == duty, "the last command holds"
    assert rig.balancer.bus_errors == 1
    rig.run(1.0)
    assert (rig.balancer.mode, rig.balancer.bus_errors) == ("balancing", 1)


@pytest.mark.parametrize("code", KINDS)
def test_what_fails_twice_is_left_to_the_next_tick(code: int) -> None:
    rig = upright().run(1.0)
    for _ in range(20):
        rig.robot.failures = [code] * 2
        rig.run(0.1)
    assert rig.balancer.mode == "balancing"
    assert rig.balancer.fault is None


def test_held_sda_is_clocked_free() -> None:
    """A device that missed a clock pulse waits for eight more with SDA low: every transfer times out until then."""
    rig = upright().run(1.0)
    rig.robot.sda_held = True
    rig.run(0.02)
    assert not rig.robot.sda_held
    assert rig.balancer.bus_errors == 1
    rig.run(2.0)
    assert rig.balancer.mode == "balancing"


def test_held_sda_at_the_start_is_clocked_free_too() -> None:
    rig = Rig()
    rig.robot.sda_held = True
    rig.run(5.0)
    assert rig.balancer.mode == "balancing"


def test_a_bus_that_cannot_be_freed_is_a_fault_with_the_motors_off(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = upright().run(1.0)
    monkeypatch.setattr(rig.robot, "recover", lambda _now: None)
    rig.robot.sda_held = True
    rig.run(1.0)
    assert rig.balancer.fault == ("bus", "I2C, ATmega: Connection timed out (error 110)")
    rig.robot.atmega.advance(rig.now)
    assert rig.robot.atmega.motors == (0.0, 0.0), "by the ATmega's watchdog"
    rig.robot.sda_held = False
    rig.run(1.5)
    assert rig.balancer.mode == "fault", "that the bus is back starts no motor"


@pytest.mark.parametrize("seed", range(5))
def test_one_failed_transfer_in_thirty_is_borne(seed: int) -> None:
    """Of all kinds, in the control step and in the slack tasks."""
    chance = random.Random(seed)
    rig = upright().run(1.0)
    tasks = SlackTasks(rig.balancer, lambda: rig.now)
    failed = 0
    for _ in range(1000):
        rig.robot.failures = [chance.choice(KINDS) if chance.random() < 1 / 30 else 0 for _ in range(20)]
        rig.run(0.01)
        tasks.run(rig.deadline)
        failed = rig.balancer.bus_errors + tasks.errors
    rig.robot.failures = []
    assert failed > 50
    assert (rig.balancer.mode, rig.balancer.fault) == ("balancing", None)
    assert abs(rig.body.tilt) < 0.2


def test_an_imu_that_did_not_take_its_setup_is_named() -> None:
    """A write that was lost would leave another range: all angles would be wrong by a factor."""
    rig = Rig()
    write = rig.robot.imu.write

    def deaf(data: bytes, now: float) -> None:
        write(data if data[:1] != bytes((imu.CTRL2_G,)) else data[:1], now)

    rig.robot.imu.write = deaf
    rig.run(1.0)
    assert rig.balancer.fault.name == "device"
    assert rig.balancer.fault.reason == "IMU at 0x6B: CTRL1_XL to CTRL3_C hold 50 00 44, 50 58 44 was written"
    assert rig.body.held
    rig.robot.imu.write = write
    rig.run(4.0)
    assert rig.balancer.fault is None


@pytest.mark.parametrize("address", [imu.ADDRESS, balboa.ADDRESS])
def test_an_absent_device_is_a_fault_until_it_is_there(address: int) -> None:
    rig = Rig(start_mode="rest")
    device = rig.robot.devices.pop(address)
    rig.run(2.0)
    who = {imu.ADDRESS: "IMU", balboa.ADDRESS: "ATmega"}[address]
    assert rig.balancer.fault == ("bus", f"I2C, {who}: Remote I/O error (error 121)")
    assert rig.body.held
    rig.robot.devices[address] = device
    rig.run(4.0)
    assert (rig.balancer.fault, rig.balancer.ready) == (None, True)


def test_an_atmega_that_was_reset_shines_again_and_the_robot_stands() -> None:
    rig = upright().run(1.0)
    rig.robot.atmega.reset(4)
    assert rig.robot.atmega.leds == (False, False, False)
    rig.run(LEDS_AGAIN_S + 0.1)
    assert rig.robot.atmega.leds == (False, False, True)
    assert (rig.balancer.mode, rig.balancer.fault) == ("balancing", None)


def test_another_layout_of_the_firmware_is_named_and_nothing_is_driven() -> None:
    rig = Rig()
    rig.robot.atmega._buffer[balboa.VERSION] = 1
    rig.run(3.0)
    assert rig.balancer.fault == ("device", "ATmega: its buffer has layout version 1, expected 2: flash the firmware")
    assert rig.body.held
