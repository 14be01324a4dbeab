"""Time on the I2C bus at 100 kHz: a control step, a tick with all else in its slack, and the rates of the thesis.

There is no bus here: each transfer waits as long as its bytes take on the wire, the ATmega's holds included, and the
pauses that the ATmega needs are slept for real, with the loop's priority where that is permitted. Drivers, balancer and
slack tasks are the robot's own; the devices are simulated.
"""

import logging
import random
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from bench.rows import Row
from services.balancer import realtime
from services.balancer.balancer import Balancer
from services.balancer.core.body import body_model
from services.balancer.core.display import ScreenText
from services.balancer.drivers import Balboa
from services.balancer.measure_i2c import measure
from services.balancer.slack_tasks import SlackTasks
from sim.core.balboa import BalboaBody
from sim.core.devices import SimulatedRobot, draw_errors
from sim.i2c import SimulatedBus
from swarm import clock
from swarm.config.types import Body
from swarm.messages import MeasureI2C, ModuleRequest

LIMIT_MS = 4.0
"""Of bus time for the control step."""
PERIOD_MS = 10.0
RATE_SIZE = 8
"""Bytes; what Pololu measured with, and the thesis found the same."""
THESIS_READ_MS = 8 * RATE_SIZE / 21.0
THESIS_WRITE_MS = 8 * RATE_SIZE / 53.0
"""Milliseconds a transfer at 21 and 53 kbit/s (thesis 2.2.5)."""
_SPIN_S = 0.3e-3


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    ticks: int = 400
    """A multiple of 100: then the last request to the module is done, and the mailbox takes what is written."""

    transfers: int = 100
    """Of each rate."""


FULL = Sizes()
SMOKE = Sizes(100, 10)


class TimedBus(SimulatedBus):
    """Every transfer takes its time."""

    def __init__(self, robot: SimulatedRobot) -> None:
        super().__init__(robot, clock.now)

    def write(self, address: int, data: bytes) -> None:
        """See `I2CBus`."""
        self._timed(lambda: super(TimedBus, self).write(address, data))

    def read(self, address: int, count: int) -> bytes:
        """See `I2CBus`."""
        data: list[bytes] = []
        self._timed(lambda: data.append(super(TimedBus, self).read(address, count)))
        return data[0]

    def write_read(self, address: int, data: bytes, count: int) -> bytes:
        """See `I2CBus`."""
        read: list[bytes] = []
        self._timed(lambda: read.append(super(TimedBus, self).write_read(address, data, count)))
        return read[0]

    def pause(self, seconds: float) -> None:
        """See `I2CBus`."""
        time.sleep(seconds)

    def untimed(self) -> float:
        """See `I2CBus`."""
        return 0.0

    def _timed(self, transfer: Callable[[], object]) -> None:
        begun, before = clock.now(), self.robot.wire_s()
        try:
            transfer()
        finally:
            _wait_until(begun + self.robot.wire_s() - before)


def _wait_until(end: float) -> None:
    """As exact as the kernel's own wait for the end of a transfer: an interrupt, not a timer."""
    left = end - clock.now() - _SPIN_S
    if left > 0.0:
        time.sleep(left)
    while clock.now() < end:
        pass


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Let it stand for some seconds with everything going on, and look at each tick."""
    realtime.enter(logging.getLogger("bench"))
    model, noise = body_model("zero2w", Body()), random.Random(1)
    robot = SimulatedRobot(BalboaBody(model, clock.now()), noise, errors=draw_errors(noise))
    bus = TimedBus(robot)
    balancer = Balancer(bus, model, 0.0, clock.now, bus.pause, start_mode="stand")
    tasks = SlackTasks(balancer, clock.now)
    while balancer.mode != "balancing":
        _tick(balancer, tasks)
    steps, ticks, wires = [], [], []
    for number in range(sizes.ticks):
        if number % 100 == 0:
            tasks.obey(ModuleRequest(f"{number}", b"\x99\xfd" + bytes(253)), clock.now())
            tasks.obey(ScreenText(tuple(f"line {n} of {number}" for n in range(7))), clock.now())
        step, tick, wire = _tick(balancer, tasks)
        steps.append(step * 1e3)
        ticks.append(tick * 1e3)
        wires.append(wire * 1e3)
    yield Row("control step, bytes on the wire and holds", statistics.median(wires), "ms", LIMIT_MS, 1.0)
    yield Row("control step, with waits and computation, p50", statistics.median(steps), "ms", LIMIT_MS, 1.0)
    yield Row("the same, p99", sorted(steps)[len(steps) * 99 // 100], "ms", LIMIT_MS, 1.0)
    yield Row("tick with all slack tasks, p99", sorted(ticks)[len(ticks) * 99 // 100], "ms", PERIOD_MS, 0.9)
    found = measure(bus, Balboa(bus, clock.now, bus.pause), MeasureI2C("bench", RATE_SIZE, sizes.transfers))
    assert found.read is not None
    assert found.write is not None
    yield Row("8 bytes read, as the thesis' rate", 8e3 * RATE_SIZE / found.read, "ms", THESIS_READ_MS, 1.0)
    yield Row("8 bytes written, as the thesis' rate", 8e3 * RATE_SIZE / found.write, "ms", THESIS_WRITE_MS, 1.3)


def _tick(balancer: Balancer, tasks: SlackTasks) -> tuple[float, float, float]:
    """One tick; its control step, all of it, and the control step's time on the wire, s."""
    begun = clock.now()
    robot = balancer.bus
    assert isinstance(robot, TimedBus)
    before = robot.robot.wire_s()
    balancer.step(begun)
    wire = robot.robot.wire_s() - before
    step = clock.now() - begun
    balancer.show_leds(clock.now())
    tasks.run(begun + PERIOD_MS / 1e3)
    tick = clock.now() - begun
    time.sleep(max(0.0, begun + PERIOD_MS / 1e3 - clock.now()))
    return step, tick, wire
