"""The firmware itself as the ATmega32U4 of a simulated robot: its ELF file in the AVR simulator (tests/firmware/avr).

`BodyAndChip` joins the simulated chip to the simulated body. `FirmwareDevice` is that chip as a device of
`sim.core.devices.SimulatedRobot`, in real time, with the DWM1001 at the chip's own UART.
"""

import math
from collections.abc import Callable
from typing import Protocol

from services.balancer.core.devices import balboa
from sim.core.atmega import AtmegaDevice
from sim.core.balboa import STEP_S, BalboaBody
from sim.core.devices import SimulatedRobot
from sim.core.module_line import ModuleLine

CYCLE_S = 1 / 16e6
LONGEST_S = 1.0
"""What the chip does at most in one go: motors have stopped by then, and what it left out nobody has seen."""
STOP_S = 2e-4
"""At most so much of the pause after a STOP is passed on to a chip that is ahead of the clock; it needs half of it."""


class Chip(Protocol):
    """What is used of the AVR simulator's binding (tests/firmware/avr_bench.py), which has more."""

    @property
    def now(self) -> float:
        """The chip's own time, s."""

    def run_to(self, time: float) -> None:
        """Run the firmware up to then."""

    def write(self, address: int, data: bytes) -> None:
        """A write transaction, at the speed of the wire; OSError as the kernel raises it."""

    def read(self, address: int, count: int) -> bytes:
        """A read transaction."""

    def motors(self) -> tuple[float, float]:
        """Duties as the motor drivers see them."""

    def counts(self) -> tuple[int, int]:
        """Where the encoders are."""

    def wheels(self, left: float, right: float) -> None:
        """Turn the encoders, counts/s."""

    def leds(self) -> tuple[bool, bool, bool]:
        """Red, yellow, green."""

    def press(self, *, a: bool, b: bool, c: bool) -> None:
        """Hold these buttons down and no others."""

    def battery(self, volts: float) -> None:
        """Set what the batteries have."""

    def feed(self, data: bytes) -> None:
        """Bytes from the DWM1001."""

    def sent_bytes(self) -> bytes:
        """Bytes for the DWM1001."""


class BodyAndChip:
    """The chip's PWM registers drive the body, whose wheels turn the chip's encoders."""

    def __init__(self, chip: Chip, body: BalboaBody) -> None:
        self._chip, self._body = chip, body
        self._offset = body.now - chip.now
        """The body's time is the caller's, which began otherwise than the chip's."""
        self._per_radian = body.model.counts_per_turn / math.tau
        self._place = [float(count) for count in chip.counts()]
        self._rate = [0.0, 0.0]
        self._then = chip.now
        self._origin = tuple(self._place)

    @property
    def now(self) -> float:
        """The chip's time by the caller's clock."""
        return self._chip.now + self._offset

    def run_to(self, end: float) -> None:
        """Let both go on, in steps of the body's integration."""
        while end - self.now > CYCLE_S:
            self.meet()
            self._chip.run_to(min(end - self._offset, self._chip.now + STEP_S))

    def skip(self, seconds: float) -> None:
        """Time passes that the chip does not see."""
        self._offset += seconds

    def meet(self) -> None:
        """Hand the motors' duty to the body, and the wheels' angles to the encoders, to be there a step later."""
        now = self._chip.now
        self._body.advance(self.now)
        self._body.drive(*self._chip.motors())
        for side, angle in enumerate(self._body.wheel_angles()):
            self._place[side] += self._rate[side] * (now - self._then)
            wanted = self._origin[side] + angle * self._per_radian
            self._rate[side] = (wanted - self._place[side]) / STEP_S
        self._chip.wheels(*self._rate)
        self._then = now


class _Uart(ModuleLine):
    """The chip's end of the DWM1001's line: who polls, and what is made of the answers, is the firmware's matter."""

    def __init__(self, chip: Chip, now: float) -> None:
        super().__init__(now)
        self._chip = chip

    def receive(self, data: bytes, now: float) -> None:
        """See `ModuleLine`."""
        del now
        self._chip.feed(data)

    def to_send(self) -> bytes:
        """See `ModuleLine`."""
        return self._chip.sent_bytes()


class FirmwareDevice(AtmegaDevice):
    """The chip at its address of the robot's bus.

    A transfer takes its time on the wire by the chip's clock at once. The caller's clock follows when the adapter has
    waited for as long (`lab.i2c.robot`), so the chip is ahead of it within a transfer.
    """

    def __init__(self, chip: Chip, body: BalboaBody, battery: float, clock: Callable[[], float]) -> None:
        self._chip, self._clock = chip, clock
        self._pair = BodyAndChip(chip, body)
        self._stopped = -math.inf
        super().__init__(body)
        self.battery = battery
        chip.battery(battery)
        self.line = _Uart(chip, body.now)

    @property
    def leds(self) -> tuple[bool, bool, bool]:
        """See `AtmegaDevice`."""
        return self._chip.leds()

    @property
    def motors(self) -> tuple[float, float]:
        """See `AtmegaDevice`."""
        return self._chip.motors()

    def press(self, buttons: int) -> None:
        """See `AtmegaDevice`."""
        self._chip.press(a=bool(buttons & 1), b=bool(buttons & 2), c=bool(buttons & 4))

    def advance(self, now: float) -> None:
        """See `AtmegaDevice`."""
        if now - self._pair.now > LONGEST_S:
            self._pair.skip(now - self._pair.now - LONGEST_S)
        self._pair.run_to(now)
        self._see_leds(now)

    def write(self, data: bytes, now: float) -> None:
        """See `AtmegaDevice`."""
        self._begin(now)
        try:
            self._chip.write(balboa.ADDRESS, data)
        finally:
            self._stopped = self._clock()

    def read(self, count: int, now: float) -> bytes:
        """See `AtmegaDevice`."""
        self._begin(now)
        try:
            return self._chip.read(balboa.ADDRESS, count)
        finally:
            self._stopped = self._clock()

    def _begin(self, now: float) -> None:
        """The pause since the STOP before is one for the chip, too, where it is ahead of the clock."""
        if self._pair.now > now:
            self._pair.run_to(self._pair.now + min(now - self._stopped, STOP_S))
        self._pair.meet()


def solder(robot: SimulatedRobot, chip: Chip, clock: Callable[[], float]) -> None:
    """Put that chip in place of the robot's simulated ATmega."""
    robot.atmega = FirmwareDevice(chip, robot.body, robot.atmega.battery, clock)
    robot.devices[balboa.ADDRESS] = robot.atmega
