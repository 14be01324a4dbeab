"""The robot behind the device file, under virtual time: each ordered fault is what the kernel would report."""

import errno
import json
import random

import pytest

from lab.i2c.ioctls import Message
from lab.i2c.robot import ANY, RobotAdapter
from services.balancer.core.control.body import body_model
from services.balancer.core.devices import balboa, imu
from services.balancer.core.slack.wire_time import HOLD_S
from services.balancer.i2c import NOBODY
from sim.core.balboa import BalboaBody
from sim.core.devices import NO_ERRORS, SimulatedRobot
from sim.devices.i2c import SimulatedBus
from swarm.config.types import Body
from swarm.errors import LocalError

WHO = [Message(imu.ADDRESS, bytes((imu.WHO_AM_I,))), Message(imu.ADDRESS, read=1)]
BIT_S = 10e-6
"""At 100 kHz."""
STOP = [Message(balboa.ADDRESS, bytes((balboa.MOTORS,)) + balboa.encode_motors(0.0, 0.0))]
VERSION = [Message(balboa.ADDRESS, bytes((balboa.VERSION,))), Message(balboa.ADDRESS, read=1)]


class Rig:
    def __init__(self) -> None:
        self.now = 100.0
        body = BalboaBody(body_model("zero2w", Body()), self.now)
        self.robot = SimulatedRobot(body, random.Random(1), errors=NO_ERRORS)
        bus = SimulatedBus(self.robot, lambda: self.now)
        self.adapter = RobotAdapter(bus, lambda: self.now, self.wait)

    def wait(self, seconds: float) -> None:
        assert seconds > 0.0
        self.now += seconds

    def fails(self, messages: list[Message], number: int) -> None:
        with pytest.raises(OSError, match=rf"\[Errno {number}\]"):
            self.adapter.transfer(messages)

    def works(self, messages: list[Message] = WHO) -> None:
        expected = imu.IDENTITY if messages is WHO else balboa.LAYOUT_VERSION
        assert self.adapter.transfer(messages) == bytes((expected,))


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_devices_answer_and_take_their_time_on_the_wire(rig: Rig) -> None:
    rig.works()
    took = (2 * 2 + 9 * 4) * BIT_S
    assert rig.now == pytest.approx(100.0 + took)
    rig.works(VERSION)
    took += (2 * 2 + 9 * 4) * BIT_S + 4 * HOLD_S
    assert rig.now == pytest.approx(100.0 + took)
    assert (rig.adapter.transfers, rig.adapter.failed) == (2, 0)
    rig.adapter.transfer(STOP)
    assert rig.now == pytest.approx(100.0 + took + (2 + 9 * 6) * BIT_S + 6 * HOLD_S)


def test_a_pause_is_time_on_the_wire_too(rig: Rig) -> None:
    rig.works()
    rig.now += 1e-3
    before = rig.now
    rig.adapter.transfer(STOP)
    assert rig.now == pytest.approx(before + (2 + 9 * 6) * BIT_S + 6 * HOLD_S)


def test_what_the_answer_took_counts(rig: Rig) -> None:
    write = rig.robot.write

    def slow(address: int, data: bytes, now: float) -> None:
        rig.now += 1.0
        write(address, data, now)

    rig.robot.write = slow  # type: ignore[method-assign]
    for _ in range(100):
        rig.works()
    assert rig.now == 200.0


@pytest.mark.parametrize(
    ("fault", "number"), [("nack", errno.EREMOTEIO), ("short", errno.EIO), ("timeout", errno.ETIMEDOUT)]
)
def test_faults_of_one_device_spoil_so_many_messages_of_it(rig: Rig, fault: str, number: int) -> None:
    setattr(rig.adapter.faults, fault, {imu.ADDRESS: 2})
    rig.works(VERSION)
    rig.fails(WHO, number)
    rig.fails(WHO, number)
    rig.works()
    assert rig.adapter.failed == 2


def test_a_time_out_takes_the_time_that_was_set(rig: Rig) -> None:
    rig.adapter.timeout_s = 0.02
    rig.adapter.faults.timeout = {ANY: 1}
    rig.fails(VERSION, errno.ETIMEDOUT)
    assert rig.now == pytest.approx(100.02)


def test_nobody_answers_where_nobody_is(rig: Rig) -> None:
    rig.fails([Message(0x33, read=1)], errno.EREMOTEIO)
    rig.fails([Message(0x33)], errno.EREMOTEIO)
    assert rig.adapter.transfer([Message(imu.ADDRESS)]) == b"", "i2cdetect looks like this"


def test_a_read_from_nobody_frees_a_device_that_holds_sda(rig: Rig) -> None:
    rig.adapter.faults.hold_sda = True
    rig.fails(WHO, errno.ETIMEDOUT)
    rig.fails([Message(NOBODY, read=1)], errno.EREMOTEIO)
    rig.works()


def test_nothing_frees_a_wire_that_is_shorted(rig: Rig) -> None:
    rig.adapter.faults.stuck = True
    rig.fails([Message(NOBODY, read=1)], errno.ETIMEDOUT)
    rig.fails(WHO, errno.ETIMEDOUT)
    rig.adapter.faults.stuck = False
    rig.works()


def test_corrupt_bytes_are_acknowledged(rig: Rig) -> None:
    rig.adapter.faults.corrupt = {imu.ADDRESS: 1}
    assert rig.adapter.transfer(WHO) == bytes((imu.IDENTITY ^ 0xFF,))
    rig.works()


def test_the_motors_stop_on_a_dead_bus(rig: Rig) -> None:
    """By the ATmega's own watchdog, whose time goes on."""
    rig.adapter.transfer([Message(balboa.ADDRESS, bytes((balboa.MOTORS,)) + balboa.encode_motors(0.5, 0.5))])
    rig.adapter.faults.stuck = True
    rig.fails(WHO, errno.ETIMEDOUT)
    rig.robot.atmega.advance(rig.now)
    assert rig.robot.atmega.motors == (0.0, 0.0)


def test_faults_are_ordered_as_json_has_them(rig: Rig) -> None:
    rig.adapter.faults.order({"nack": {"107": 1}, "stuck": False})
    assert rig.adapter.report()["faults"]["nack"] == {imu.ADDRESS: 1}
    rig.fails(WHO, errno.EREMOTEIO)
    rig.works()
    with pytest.raises(LocalError, match="faults: nak unknown; there are corrupt, hold_sda, mask, nack"):
        rig.adapter.faults.order({"nak": {}})
    assert json.loads(json.dumps(rig.adapter.report()))["failed"] == 1
