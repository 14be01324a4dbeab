"""The simulated ATmega and the real firmware behind one interface, so that the same tests run against both."""

import random
from collections.abc import Callable

from avr_bench import Bench
from elf_robot import ElfRobot

from services.balancer.core.control.body import body_model
from sim.core.balboa import BalboaBody
from sim.core.devices import NO_ERRORS, SimulatedRobot
from sim.devices.i2c import SimulatedBus
from swarm.config.types import Body

CONFIGURED = body_model("zero2w", Body())
STEP = 0.0005


class Simulated:
    """sim on a clock set by hand."""

    def __init__(self) -> None:
        self.now = 100.0
        self.body = BalboaBody(CONFIGURED, self.now)
        self.robot = SimulatedRobot(self.body, random.Random(1), errors=NO_ERRORS)
        self.bus = SimulatedBus(self.robot, self.clock)
        self._sent = b""

    def clock(self) -> float:
        return self.now

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.now = min(end, self.now + STEP)
            self.robot.atmega.advance(self.now)
            self._sent += self.robot.atmega.line.to_send()

    def sent(self) -> bytes:
        self._sent += self.robot.atmega.line.to_send()
        sent, self._sent = self._sent, b""
        return sent

    def feed(self, data: bytes) -> None:
        self.robot.atmega.line.receive(data, self.now)

    def press(self, down: int) -> None:
        self.robot.atmega.press(down)

    def battery(self, volts: float) -> None:
        self.robot.atmega.battery = volts

    def motors(self) -> tuple[float, float]:
        return self.robot.atmega.motors

    def leds(self) -> tuple[bool, bool, bool]:
        return self.robot.atmega.leds

    def reset(self, cause: int) -> None:
        self.robot.atmega.reset(cause)


class Real:
    """The ELF in the AVR simulator."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        bench.battery(7.4)
        bench.run(0.2)  # the battery is a mean of 160 ms
        bench.sent()
        self.bus = ElfRobot(bench, CONFIGURED)
        self.clock: Callable[[], float] = self.bus.clock

    def run(self, seconds: float) -> None:
        self.bus.run_to(self.bench.now + seconds)

    def sent(self) -> bytes:
        return self.bench.sent_bytes()

    def feed(self, data: bytes) -> None:
        self.bench.feed(data)

    def press(self, down: int) -> None:
        self.bench.press(a=bool(down & 1), b=bool(down & 2), c=bool(down & 4))

    def battery(self, volts: float) -> None:
        self.bench.battery(volts)

    def motors(self) -> tuple[float, float]:
        return self.bench.motors()

    def leds(self) -> tuple[bool, bool, bool]:
        return self.bench.leds()

    def reset(self, cause: int) -> None:
        self.bench.call("reset", cause)
        self.bench.run(0.02)
