"""The firmware behind the lab's I2C adapter (lab/i2c): the balancer's own code stands through both, in virtual time."""

import random
from collections.abc import Callable

import pytest
from avr_bench import Bench

from lab.i2c.firmware import LONGEST_S, solder
from lab.i2c.ioctls import Message
from lab.i2c.robot import RobotAdapter
from services.balancer.balancer import Balancer
from services.balancer.core.control.body import body_model
from services.balancer.core.control.lqr import PERIOD_S
from services.balancer.core.devices import balboa
from services.balancer.i2c import NOBODY
from services.balancer.slack_tasks import SlackTasks
from services.dwm.core.module.tlv import Location, Position, encode_location
from sim.core.balboa import BalboaBody
from sim.core.devices import SimulatedRobot, draw_errors
from sim.devices.i2c import SimulatedBus
from swarm.config.types import Body
from swarm.messages import Battery, Uwb

pytest_plugins = ("firmware_fixtures",)

MODEL = body_model("zero2w", Body())
BOOTED = 1000.0
"""The caller's clock when the chip gets its power."""
CALL_S = 2e-4
"""What a call of the kernel takes beside the wire."""


class Adapted:
    """A robot behind the adapter, as `I2CBus`; a module that answers every poll."""

    def __init__(self, chip: Bench) -> None:
        self.now = BOOTED
        self.chip = chip
        noise = random.Random(1)
        self.robot = SimulatedRobot(BalboaBody(MODEL, self.now), noise, errors=draw_errors(noise))
        solder(self.robot, chip, self.clock)
        self.adapter = RobotAdapter(SimulatedBus(self.robot, self.clock), self.clock, self.sleep)

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def write(self, address: int, data: bytes) -> None:
        self._transfer(Message(address, data))

    def read(self, address: int, count: int) -> bytes:
        return self._transfer(Message(address, read=count))

    def write_read(self, address: int, data: bytes, count: int) -> bytes:
        return self._transfer(Message(address, data), Message(address, read=count))

    def recover(self) -> None:
        self._transfer(Message(NOBODY, read=1))

    pause = sleep

    def untimed(self) -> float:
        return 0.0

    def close(self) -> None:
        pass

    def _transfer(self, *messages: Message) -> bytes:
        self.now += CALL_S
        return self.adapter.transfer(list(messages))


@pytest.fixture
def adapted(bench: Bench) -> Adapted:
    return Adapted(bench)


def test_a_robot_stands_and_localizes_through_the_adapter(adapted: Adapted) -> None:
    balancer = Balancer(adapted, MODEL, 0.0, adapted.clock, adapted.sleep, start_mode="stand")
    tasks = SlackTasks(balancer, adapted.clock)
    news: list[object] = []
    tilts = []
    deadline = adapted.now
    while deadline < BOOTED + 4.5:
        adapted.now = max(adapted.now, deadline)
        balancer.step(adapted.now)
        news += tasks.run(deadline + PERIOD_S)
        if adapted.robot.atmega.line.to_send():
            place = Position(1.0, 2.0, 0.1, 90)
            adapted.robot.atmega.line.receive(encode_location(Location(place, ())), adapted.now)
        if deadline > BOOTED + 3.0:
            tilts.append(adapted.robot.body.tilt)
        deadline += PERIOD_S
    assert balancer.mode == "balancing", balancer.fault
    assert max(map(abs, tilts)) < 0.1
    assert adapted.adapter.failed == 0
    assert [each for each in news if isinstance(each, Battery)][-1].voltage == pytest.approx(7.4, abs=0.1)
    reports = [each for each in news if isinstance(each, Uwb) and each.t > BOOTED + 3.0]
    assert {each.state for each in reports} == {"ok"}
    assert len({each.sequence for each in reports}) >= 13


@pytest.mark.parametrize("silence", [0.25, 3 * LONGEST_S])
def test_motors_stop_when_nobody_commands_them(adapted: Adapted, silence: float) -> None:
    adapted.write(balboa.ADDRESS, bytes((balboa.MOTORS,)) + balboa.encode_motors(0.2, 0.2))
    adapted.sleep(0.1)
    adapted.robot.atmega.advance(adapted.now)
    assert adapted.adapter.report()["motors"] == pytest.approx((0.2, 0.2), abs=0.01)
    adapted.sleep(silence)
    assert adapted.adapter.report()["motors"] == (0.0, 0.0)
    assert adapted.write_read(balboa.ADDRESS, bytes((balboa.VERSION,)), 1) == bytes((balboa.LAYOUT_VERSION,))


def test_transfers_in_a_row_find_the_chip_awake(adapted: Adapted) -> None:
    """The chip is deaf to an address that comes right after a STOP, and ahead of the clock within a tick."""
    ask: list[Callable[[], object]] = [
        lambda: adapted.write(balboa.ADDRESS, bytes((balboa.ENCODERS,))),
        lambda: adapted.read(balboa.ADDRESS, 4),
    ]
    began, chip = adapted.now, adapted.chip.now
    for turn in range(200):
        ask[turn % 2]()
    adapted.robot.atmega.advance(adapted.now)
    assert adapted.adapter.failed == 0
    assert adapted.chip.now - chip == pytest.approx(adapted.now - began, abs=0.004)
