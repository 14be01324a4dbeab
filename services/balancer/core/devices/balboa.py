"""The registers of the ATmega32U4 at I2C slave 20: our layout, version 2. The firmware's header must match this table.

A write is an index byte and data from that index, applied together at STOP; a byte that fits nowhere is not
acknowledged (error 121) and nothing of that write is applied. A read is a write of the index byte, STOP, a pause of
100 us, then the bytes, all of the moment of the index. All numbers are little-endian. firmware/README.md tells what
each field means; names are those of the firmware.

What changes every tick is together, so that a tick is one burst read and one burst write.
"""

import math
import struct
from typing import NamedTuple

from swarm.errors import LocalError, RemoteError

ADDRESS = 20

LAYOUT_VERSION = 2
VERSION = 0
LEDS = 1
MOTORS = 4
ENCODERS = 8
BUTTONS = 12
STATUS = 13
BATTERY = 14
RESET_CAUSE = 16
REVISION = 17
FREE_STACK = 18
ENCODER_ERRORS = 20
REFUSED = 22
BUS_RESETS = 23
UWB_STATE = 24
UWB_ERROR = 25
UWB_BAD = 26
NOTES_LEFT = 27
MAILBOX_STATE = 28
MAILBOX_ECHO = 29
MAILBOX_LENGTH = 30
UWB = 32
COMMAND = 144
NOTES = 160
MAILBOX_TOKEN = 192
MAILBOX_REQUEST_LENGTH = 193
MAILBOX_PAGE = 194
MAILBOX_WINDOW = 195
"""Offsets."""

JOINED = 223
"""An index from here on reads ENCODERS to STATUS, and then goes on at four times what it is above this."""
LAST_JOINED = 124
"""The last offset that has such an index."""
ONWARD = 255
"""The index that goes on where the last such read ended."""

UWB_SIZE = 100
UWB_RANGES = 4
UWB_PLACE_SIZE = 13
UWB_RANGE_SIZE = 7
TUNE_NOTES = 15
WINDOW_SIZE = 28
BOOTLOADER_COMMAND = 0xB007

SIZE = 32
"""Bytes before the UWB block."""

PAUSE_S = 150e-6
"""Between a STOP and the next START to the ATmega: its TWI is deaf while the STOP interrupt is pending. At 100 us the
simulator has missed no address (firmware/README.md, Protocol)."""

MOTOR_TOP = 400
"""Timer 1's top: a command of 400 is a duty of 1."""
MOTOR_TIMEOUT_S = 0.2
"""The firmware stops the motors this long after the last motor write."""
STOPPED_BY_WATCHDOG = 0x01

RESET_CAUSES = {
    0x01: "power-on",
    0x02: "reset pin",
    0x04: "brown-out",
    0x08: "watchdog",
    0x40: "its main loop had hung",
    0x80: "with the power on",
}
"""Bits of RESET_CAUSE."""

_PAIR = struct.Struct("<2h")
_MOTION = struct.Struct("<2hBB")
_HOUSEKEEPING = struct.Struct("<BBHBBHBBBB")
_PROGRESS = struct.Struct("<BBBB")

MOTION_SIZE = _MOTION.size
"""Bytes from ENCODERS to STATUS: what is read in every tick."""
HOUSEKEEPING_SIZE = _HOUSEKEEPING.size
"""Bytes from BUTTONS to BUS_RESETS."""
PROGRESS_SIZE = _PROGRESS.size
"""Bytes from UWB_STATE to NOTES_LEFT."""


class MotionBlock(NamedTuple):
    """The block of registers that is read in every tick."""

    left: int
    """Encoder counts, -32768..32767, wrapping."""
    right: int
    buttons: int
    """Bit 0 A, bit 1 B, bit 2 C: pressed."""
    stopped_by_watchdog: bool
    newest_report: int = 0
    """The sequence number of the newest UWB report, modulo 16."""


class Housekeeping(NamedTuple):
    """The block of registers that is read once in a while."""

    buttons: tuple[bool, bool, bool]
    """A, B, C."""
    stopped_by_watchdog: bool
    battery: float
    """V."""
    reset_cause: int
    """Bits of RESET_CAUSES."""
    revision: int
    """Release of the firmware."""
    free_stack: int
    """Bytes that its stack has never reached."""
    encoder_errors: tuple[int, int]
    """Left, right, wrapping at 256: both channels changed at once."""
    refused: int
    """Writes refused, wrapping at 256."""
    bus_resets: int
    """Transfers that we left in the middle, wrapping at 256."""


class UwbProgress(NamedTuple):
    """The state of the UWB module's serial line and of the buzzer."""

    uwb_state: int
    uwb_error: int
    uwb_bad: int
    """Wrapping at 256."""
    notes_left: int


def joined(offset: int) -> int:
    """Return the index that reads ENCODERS to STATUS and goes on at `offset`, a multiple of 4 from BUTTONS to
    LAST_JOINED."""
    if offset % 4 or not BUTTONS <= offset <= LAST_JOINED:
        raise LocalError(f"offset {offset} cannot be joined to the encoders")
    return JOINED + offset // 4


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
    return _PAIR.pack(_of_top(left), _of_top(right))


def decode_motors(data: bytes) -> tuple[float, float]:
    """Return the inverse of `encode_motors`, as the firmware reads it: beyond the top is the top."""
    left, right = _PAIR.unpack(data)
    return (
        min(MOTOR_TOP, max(-MOTOR_TOP, left)) / MOTOR_TOP,
        min(MOTOR_TOP, max(-MOTOR_TOP, right)) / MOTOR_TOP,
    )


def _of_top(duty: float) -> int:
    return round(min(1.0, max(-1.0, duty)) * MOTOR_TOP)


def encode_leds(red: bool, yellow: bool, green: bool) -> bytes:
    """Return the bytes at LEDS."""
    return bytes((red, yellow, green))


def decode_motion(data: bytes) -> MotionBlock:
    """Decode the bytes from ENCODERS to STATUS. Raises `RemoteError` on a short block."""
    left, right, buttons, status = _unpack(_MOTION, data, "encoders")
    return MotionBlock(left, right, buttons & 7, bool(status & STOPPED_BY_WATCHDOG), status >> 4)


def encoder_step(old: int, new: int) -> int:
    """Counts from `old` to `new` of a 16-bit counter that wraps: the way of fewer than 32768 counts."""
    return (new - old + 0x8000) % 0x10000 - 0x8000


def decode_housekeeping(data: bytes) -> Housekeeping:
    """Decode the bytes from BUTTONS to BUS_RESETS. Raises `RemoteError` on a short block."""
    buttons, status, millivolts, cause, revision, stack, left, right, refused, resets = _unpack(
        _HOUSEKEEPING, data, "housekeeping"
    )
    return Housekeeping(
        (bool(buttons & 1), bool(buttons & 2), bool(buttons & 4)),
        bool(status & STOPPED_BY_WATCHDOG),
        millivolts / 1e3,
        cause,
        revision,
        stack,
        (left, right),
        refused,
        resets,
    )


def decode_progress(data: bytes) -> UwbProgress:
    """Decode the bytes from UWB_STATE on. Raises `RemoteError` on a short block."""
    return UwbProgress(*_unpack(_PROGRESS, data, "progress"))


def describe_reset(cause: int) -> str:
    """RESET_CAUSE in words. Behind Pololu's bootloader a power-on shows no bit at all, a reset button none but the
    last one (firmware/README.md)."""
    return ", ".join(text for bit, text in RESET_CAUSES.items() if cause & bit) or "power-on"


def _unpack(layout: struct.Struct, data: bytes, what: str) -> tuple[int, ...]:
    if len(data) != layout.size:
        raise RemoteError(f"ATmega: {len(data)} bytes of {what} instead of {layout.size}")
    return layout.unpack(data)
