"""Time on the I2C bus at 100 kHz: a control step, a tick with all else in its slack, and the rates of the thesis. Then,
under virtual time, how often a UWB report is read at the clocks that Pis have, by the CPU time of a tick.

There is no bus here: each transfer waits as long as its bytes take on the wire, the ATmega's holds included, and the
pauses that the ATmega needs are slept for real, with the loop's priority where that is permitted. Drivers, balancer and
slack tasks are the robot's own; the devices are simulated.
"""

import logging
import math
import random
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass

from bench.rigs.timed_robot import TimedRobot
from bench.rows import Row
from services.balancer import realtime
from services.balancer.balancer import Balancer
from services.balancer.core.control.body import body_model
from services.balancer.core.devices.display import ScreenText
from services.balancer.device_drivers import Balboa
from services.balancer.measure_i2c import measure
from services.balancer.slack_tasks import SlackTasks
from sim.core.balboa import BalboaBody
from sim.core.devices import SimulatedRobot, draw_errors
from sim.devices.i2c import SimulatedBus
from swarm import clock
from swarm.config.types import Body
from swarm.core.percentile import percentile
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

REPORT_MS = 1e3 / 9.0
"""At most from one UWB report to the next, where the wire can carry them all (docs/reference/robot/i2c-bus.md)."""


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    ticks: int = 400
    """A multiple of 100: then the last request to the module is done, and the mailbox takes what is written."""

    transfers: int = 100
    """Of each rate."""
    balancing: float = 20.0
    """Seconds of virtual time for each clock and CPU time."""
    clocks_khz: tuple[float, ...] = (40.0, 50.0, 62.5, 80.0, 100.0)
    cpu_ms: tuple[float, ...] = (0.0, 0.5, 1.0, 1.5, 2.0)


FULL = Sizes()
SMOKE = Sizes(100, 10, 2.0, (62.5,), (1.0,))


def _take(seconds: float) -> None:
    """As exact as the kernel's own wait for the end of a transfer: an interrupt, not a timer."""
    end = clock.now() + seconds
    if seconds > _SPIN_S:
        time.sleep(seconds - _SPIN_S)
    while clock.now() < end:
        pass


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Let it stand for some seconds with everything going on, and look at each tick."""
    realtime.enter(logging.getLogger("bench"))
    model, noise = body_model("zero2w", Body()), random.Random(1)
    robot = SimulatedRobot(BalboaBody(model, clock.now()), noise, errors=draw_errors(noise))
    bus = SimulatedBus(robot, clock.now, take=_take)
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
    yield Row("the same, p99", percentile(steps, 99), "ms", LIMIT_MS, 1.0)
    yield Row("tick with all slack tasks, p99", percentile(ticks, 99), "ms", PERIOD_MS, 0.9)
    found = measure(bus, Balboa(bus, clock.now, bus.pause), MeasureI2C("bench", RATE_SIZE, sizes.transfers))
    assert found.read is not None
    assert found.write is not None
    yield Row("8 bytes read, as the thesis' rate", 8e3 * RATE_SIZE / found.read, "ms", THESIS_READ_MS, 1.0)
    yield Row("8 bytes written, as the thesis' rate", 8e3 * RATE_SIZE / found.write, "ms", THESIS_WRITE_MS, 1.3)
    for clock_khz in sizes.clocks_khz:
        for cpu_ms in sizes.cpu_ms:
            result = TimedRobot(scl=clock_khz * 1e3, cpu=cpu_ms * 1e-3).measure(sizes.balancing)
            missed = f", {result.missed} ticks missed" if result.missed else ""
            behind = f", behind: {' '.join(sorted(result.behind))}" if result.behind else ""
            carried = clock_khz >= 50.0 or cpu_ms <= 0.5
            every = 1e3 / result.uwb if result.uwb else math.inf
            name = f"UWB report every, at {clock_khz:g} kHz and {cpu_ms:g} ms CPU{missed}{behind}"
            yield Row(name, every, "ms", REPORT_MS, 1.0 if carried else None)


def _tick(balancer: Balancer, tasks: SlackTasks) -> tuple[float, float, float]:
    """One tick; its control step, all of it, and the control step's time on the wire, s."""
    begun = clock.now()
    bus = balancer.bus
    assert isinstance(bus, SimulatedBus)
    before = bus.robot.wire_s()
    balancer.step(begun)
    wire = bus.robot.wire_s() - before
    step = clock.now() - begun
    balancer.show_leds(clock.now())
    tasks.run(begun + PERIOD_MS / 1e3)
    tick = clock.now() - begun
    time.sleep(max(0.0, begun + PERIOD_MS / 1e3 - clock.now()))
    return step, tick, wire
