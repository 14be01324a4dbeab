"""What the ATmega32U4 offers at I2C slave 20: our layout, version 1. The firmware's header must match this table.

A write is an index byte and data from that index; a read is a write of the index byte, STOP, a pause of 100 us, then
the bytes. All numbers are little-endian. Names are those of the firmware.

| offset | bytes | name          | who writes | meaning                                                    |
|--------|-------|---------------|------------|------------------------------------------------------------|
| 0      | 1     | version       | firmware   | LAYOUT_VERSION; another one is refused                     |
| 1      | 3     | leds          | Pi         | red, yellow, green: 0 off, 1 on                            |
| 4      | 4     | motors        | Pi         | int16 left, right: -400..400 = duty -1..1, forward positive |
| 8      | 4     | encoders      | firmware   | int16 left, right: counts, wrapping, forward positive      |
| 12     | 1     | buttons       | firmware   | bit 0 A, bit 1 B, bit 2 C: 1 = pressed                     |
| 13     | 1     | status        | firmware   | bit 0: motors stopped because no motor write came in time  |
| 14     | 2     | battery       | firmware   | uint16, mV                                                 |
| 16     | 16    | (reserved)    |            | notes, reset cause, mailbox                                |
| 32     | -     | (reserved)    |            | UWB block                                                  |

What changes every tick is together, so that a tick is one burst read and one burst write.
"""

import math
import struct
from typing import NamedTuple

from swarm.errors import LocalError, RemoteError

ADDRESS = 20

LAYOUT_VERSION = 1
VERSION = 0
LEDS = 1
MOTORS = 4
ENCODERS = 8
BUTTONS = 12
STATUS = 13
BATTERY = 14
SIZE = 32
"""Bytes in use before the UWB block."""

PAUSE_S = 150e-6
"""Between a STOP and the next START to the ATmega: its TWI is deaf while the STOP interrupt is pending. 100 us is the
least that never failed in the simulator with a 60 us critical section (docs/balancer.md)."""

MOTOR_TOP = 400
"""Timer 1's top: a command of 400 is a duty of 1."""
MOTOR_TIMEOUT_S = 0.2
"""The firmware stops the motors this long after the last motor write."""
COUNTS_PER_MOTOR_TURN = 12
STOPPED_BY_WATCHDOG = 0x01

_PAIR = struct.Struct("<2h")
_HOUSEKEEPING = struct.Struct("<BBH")


class Housekeeping(NamedTuple):
    """What is read now and then."""

    buttons: tuple[bool, bool, bool]
    stopped_by_watchdog: bool
    battery: float
    """V."""


def check_version(value: int) -> None:
    """Raises `RemoteError` where the firmware speaks another layout."""
    if value != LAYOUT_VERSION:
        raise RemoteError(
            f"ATmega: its buffer has layout version {value}, expected {LAYOUT_VERSION}: flash the firmware"
        )


def encode_motors(left: float, right: float) -> bytes:
    """Duties, clamped to -1..1, as the bytes at MOTORS. Raises `LocalError` for a number that is not finite."""
    if not (math.isfinite(left) and math.isfinite(right)):
        raise LocalError(f"motor command ({left}, {right}) is not finite")
    return _PAIR.pack(*(round(min(1.0, max(-1.0, duty)) * MOTOR_TOP) for duty in (left, right)))


def decode_motors(data: bytes) -> tuple[float, float]:
    """The inverse of `encode_motors`, as the firmware reads it: beyond the top is the top."""
    left, right = _PAIR.unpack(data)
    return (
        min(MOTOR_TOP, max(-MOTOR_TOP, left)) / MOTOR_TOP,
        min(MOTOR_TOP, max(-MOTOR_TOP, right)) / MOTOR_TOP,
    )


def encode_leds(red: bool, yellow: bool, green: bool) -> bytes:
    """The bytes at LEDS."""
    return bytes((red, yellow, green))


def decode_encoders(data: bytes) -> tuple[int, int]:
    """Counters left and right, -32768..32767. Raises `RemoteError` on a short block."""
    if len(data) != _PAIR.size:
        raise RemoteError(f"ATmega: {len(data)} bytes of encoders instead of {_PAIR.size}")
    left, right = _PAIR.unpack(data)
    return left, right


def encoder_step(old: int, new: int) -> int:
    """Counts from `old` to `new` of a 16-bit counter that wraps: the way of fewer than 32768 counts."""
    return (new - old + 0x8000) % 0x10000 - 0x8000


def decode_housekeeping(data: bytes) -> Housekeeping:
    """The bytes from BUTTONS to the end of BATTERY. Raises `RemoteError` on a short block."""
    if len(data) != _HOUSEKEEPING.size:
        raise RemoteError(f"ATmega: {len(data)} bytes of housekeeping instead of {_HOUSEKEEPING.size}")
    buttons, status, millivolts = _HOUSEKEEPING.unpack(data)
    return Housekeeping(
        (bool(buttons & 1), bool(buttons & 2), bool(buttons & 4)), bool(status & STOPPED_BY_WATCHDOG), millivolts / 1e3
    )


HOUSEKEEPING_SIZE = _HOUSEKEEPING.size
