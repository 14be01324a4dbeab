"""The ATmega32U4 with our firmware at the level of its I2C protocol, with a simulated body behind it.

The firmware is the reference (firmware/slave.cpp, README.md there); the drivers' tests run against this and against the
real ELF in an AVR simulator. Every transfer first moves the body on to `now`, the time of the caller's clock.
"""

import errno
import math
import os
import struct
from collections import deque

from services.balancer.core.devices import balboa
from services.balancer.core.devices.mailbox import MailboxState as Mail
from sim.core.balboa import BalboaBody
from sim.core.module_line import PAGES, ModuleLine

_NOTES_ROOM = 1 + 2 * balboa.TUNE_NOTES
_WINDOW_END = balboa.MAILBOX_WINDOW + balboa.WINDOW_SIZE
_CHANGES_KEPT = 64
_FREE_STACK = 1100
"""Bytes of free stack that the firmware shows in the simulator."""
_STOPPED = bytes(4)
"""The field MOTORS with both duties 0."""

_MOTION = struct.Struct("<2HB")
_BATTERY = struct.Struct("<H")
_PROGRESS = struct.Struct("<BBBBBBH")


def _no_report() -> bytes:
    """Return the UWB block before any was asked for."""
    return bytes(balboa.UWB_SIZE)


class AtmegaDevice:
    """Buffer, motors with their watchdog, encoders, LEDs, buttons, battery, notes, and the DWM1001's line."""

    def __init__(self, body: BalboaBody) -> None:
        self._body = body
        self._now = body.now
        self.battery = 7.4
        """V."""
        self.tune: tuple[int, tuple[tuple[int, int], ...]] = (0, ())
        """The tune that was written last: volume, pairs of pitch and duration in 10 ms."""
        self.in_bootloader = False
        self.led_changes: deque[tuple[float, tuple[bool, bool, bool]]] = deque(maxlen=_CHANGES_KEPT)
        """The times and values of changes of the LEDs' registers; the world takes them out."""
        self._lit = (False, False, False)
        self._buttons = 0
        self._motor_signs, self._encoder_signs = [1, 1], [1, 1]
        self.reset(0)

    def reset(self, cause: int) -> None:
        """Reset, with these bits of RESET_CAUSE."""
        self._body.drive(0.0, 0.0)
        self._buffer = bytearray(balboa.SIZE)
        self._buffer[balboa.VERSION] = balboa.LAYOUT_VERSION
        self._buffer[balboa.RESET_CAUSE] = cause
        self._buffer[balboa.REVISION] = 2
        struct.pack_into("<H", self._buffer, balboa.FREE_STACK, _FREE_STACK)
        self._origin = self._counts()
        self._motors_until = -math.inf
        self._notes_until = -math.inf
        self._index = self._onward = self._mark = 0
        self._marking = False
        self._page = 0
        self.line = ModuleLine(self._now)
        self._see_leds(self._now)
        self._front, self._report = bytes(self._buffer), _no_report

    @property
    def leds(self) -> tuple[bool, bool, bool]:
        """Return whether the red, the yellow and the green LED shine."""
        red, yellow, green = self._buffer[balboa.LEDS : balboa.LEDS + 3]
        return bool(red), bool(yellow), bool(green)

    @property
    def motors(self) -> tuple[float, float]:
        """Return the duties in force, left and right."""
        return balboa.decode_motors(bytes(self._buffer[balboa.MOTORS : balboa.MOTORS + 4]))

    def press(self, buttons: int) -> None:
        """Hold buttons down: bit 0 is A, bit 1 is B, bit 2 is C."""
        self._buttons = buttons & 7

    def reverse(self, what: str, side: int, *, reversed_: bool) -> None:
        """Swap the wires of a motor or encoder (`what`), of the left (0) or right (1) side; or put them right."""
        sign = -1 if reversed_ else 1
        if what == "motor":
            self._motor_signs[side] = sign
        elif self._encoder_signs[side] != sign:
            # The count goes on from where it is, as the firmware's does.
            before = self._counts()[side]
            self._encoder_signs[side] = sign
            origin = list(self._origin)
            origin[side] += self._counts()[side] - before
            self._origin = (origin[0], origin[1])

    def advance(self, now: float) -> None:
        """Move the body on; the motors stop on the way when their time is over."""
        if now > self._motors_until and self._buffer[balboa.MOTORS : balboa.ENCODERS] != _STOPPED:
            self._body.advance(self._motors_until)
            self._body.drive(0.0, 0.0)
            self._buffer[balboa.MOTORS : balboa.ENCODERS] = _STOPPED
            self._buffer[balboa.STATUS] |= balboa.STOPPED_BY_WATCHDOG
        self._body.advance(now)
        self._now = now
        self.line.handle_timer(now)

    def write(self, data: bytes, now: float) -> None:
        """Take an index, at which the values are frozen, and data. What does not fit is not acknowledged."""
        self._index, self._onward, self._marking = data[0], 0, False
        if data[0] >= balboa.JOINED:
            self._index = balboa.ENCODERS
            self._onward = self._mark if data[0] == balboa.ONWARD else 4 * (data[0] - balboa.JOINED)
        self._freeze(now)
        if balboa.UWB in (data[0], self._onward):
            self._report = self.line.reporting(now)
        values = data[1:]
        if not values:
            return
        if len(values) > self._room():
            self._refuse()
            raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))
        if not self._apply(values, now):
            self._refuse()

    def read(self, count: int, now: float) -> bytes:
        """Return bytes from the index on; beyond the last field they are zeros."""
        del now
        joint = balboa.STATUS + 1
        if self._onward and self._index <= joint < self._index + count:
            first, onward = joint - self._index, self._onward
            self._onward = 0
            before = self._run(first)
            self._index, self._marking = onward, True
            return before + self._run(count - first)
        return self._run(count)

    def _run(self, count: int) -> bytes:
        """Return bytes from the index on, one after the other."""
        start, self._index = self._index, min(0xFF, self._index + count)
        if self._marking:
            self._mark = self._index
        if start + count <= balboa.SIZE:
            return self._front[start : start + count]
        report = self._report()
        return bytes(self._at(at, report) for at in range(start, start + count))

    def _counts(self) -> tuple[int, int]:
        per_radian = self._body.model.counts_per_turn / math.tau
        left, right = self._body.wheel_angles()
        signs = self._encoder_signs
        return math.floor(left * per_radian) * signs[0], math.floor(right * per_radian) * signs[1]

    def _freeze(self, now: float) -> None:
        left, right = self._counts()
        first = self._origin
        buffer, line = self._buffer, self.line
        _MOTION.pack_into(
            buffer, balboa.ENCODERS, (left - first[0]) & 0xFFFF, (right - first[1]) & 0xFFFF, self._buttons
        )
        _BATTERY.pack_into(buffer, balboa.BATTERY, round(self.battery * 1e3))
        _PROGRESS.pack_into(
            buffer,
            balboa.UWB_STATE,
            line.state,
            line.error,
            line.bad,
            self._notes_left(now),
            line.mail,
            line.echo,
            line.answer_length,
        )
        buffer[balboa.STATUS] = buffer[balboa.STATUS] & 0x0F | line.newest % 16 << 4
        self._front = bytes(buffer)

    def _notes_left(self, now: float) -> int:
        end, left = self._notes_until, 0
        if now >= end:
            return 0
        for _, duration in reversed(self.tune[1]):
            left += now < end and duration > 0
            end -= duration * 0.01
        return left

    def _at(self, at: int, report: bytes) -> int:
        if at < balboa.SIZE:
            return self._front[at]
        if at < balboa.UWB + balboa.UWB_SIZE:
            return report[at - balboa.UWB]
        if at == balboa.MAILBOX_PAGE:
            return self._page
        if balboa.MAILBOX_WINDOW <= at < _WINDOW_END:
            return self.line.mailbox[self._page * balboa.WINDOW_SIZE + at - balboa.MAILBOX_WINDOW]
        return 0

    def _room(self) -> int:
        at = self._index
        if balboa.LEDS <= at <= balboa.MOTORS:
            return balboa.ENCODERS - at
        if at == balboa.COMMAND:
            return 2
        if at == balboa.NOTES:
            return _NOTES_ROOM
        if self.line.mail == Mail.BUSY:
            return 0
        if at == balboa.MAILBOX_TOKEN:
            return 2
        return _WINDOW_END - at if balboa.MAILBOX_PAGE <= at < _WINDOW_END else 0

    def _see_leds(self, now: float) -> None:
        if (leds := self.leds) != self._lit:
            self._lit = leds
            self.led_changes.append((now, leds))

    def _refuse(self) -> None:
        self._buffer[balboa.REFUSED] = (self._buffer[balboa.REFUSED] + 1) % 256

    def _apply(self, values: bytes, now: float) -> bool:
        """Apply values that were written at the index. Return False for values that make no sense."""
        first = self._index
        if first < balboa.ENCODERS:
            end = first + len(values)
            if balboa.MOTORS < end < balboa.ENCODERS:
                return False
            self._buffer[first:end] = values
            self._see_leds(now)
            if end == balboa.ENCODERS:
                duties = self.motors
                self._buffer[balboa.MOTORS : balboa.ENCODERS] = balboa.encode_motors(*duties)
                self._body.drive(duties[0] * self._motor_signs[0], duties[1] * self._motor_signs[1])
                self._motors_until = now + balboa.MOTOR_TIMEOUT_S
                self._buffer[balboa.STATUS] &= ~balboa.STOPPED_BY_WATCHDOG
            return True
        if first == balboa.COMMAND:
            self.in_bootloader = values == balboa.BOOTLOADER_COMMAND.to_bytes(2, "little")
            if self.in_bootloader:
                self._body.drive(0.0, 0.0)
            return self.in_bootloader
        if first == balboa.NOTES:
            return self._play(values, now)
        if first == balboa.MAILBOX_TOKEN:
            if len(values) != 2 or values[1] == 0:
                return False
            self.line.post(values[0], values[1])
            return True
        return self._lay(first - balboa.MAILBOX_PAGE, values)

    def _play(self, values: bytes, now: float) -> bool:
        if len(values) % 2 == 0:
            return False
        notes = tuple(zip(values[1::2], values[2::2], strict=True))
        self.tune = (values[0], notes)
        self._notes_until = now + sum(duration for _, duration in notes) * 0.01
        return True

    def _lay(self, offset: int, values: bytes) -> bool:
        if offset == 0:
            if values[0] >= PAGES:
                return False
            self._page, values = values[0], values[1:]
        else:
            offset -= 1
        start = self._page * balboa.WINDOW_SIZE + offset
        self.line.mailbox[start : start + len(values)] = values
        return True
