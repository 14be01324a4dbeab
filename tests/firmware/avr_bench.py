"""The simulated ATmega32U4 on its board, from Python: a ctypes binding of avr/bench.h with times in seconds.

`Bench` is also an I2C bus in the sense of services/balancer/i2c.py: the project's drivers run on it unchanged.
"""

import ctypes
import errno
import os
import struct
from pathlib import Path
from typing import NamedTuple

from firmware_layout import CONSTANTS, FIELDS, UWB_HEAD, UWB_TAIL

HZ = 16_000_000
GAP = 100e-6
"""What the Pi waits after a STOP."""
LEFT, RIGHT = 0, 1
POWER_ON, RESET_PIN, BROWN_OUT, WATCHDOG = 1, 2, 4, 8
"""Flags in MCUSR."""

_P, _I, _D = ctypes.c_void_p, ctypes.c_int, ctypes.c_double
_U8, _U16, _U32, _U64 = ctypes.c_uint8, ctypes.c_uint16, ctypes.c_uint32, ctypes.c_uint64
_C, _B, _N = ctypes.c_char, ctypes.c_char_p, ctypes.c_size_t

_FUNCTIONS = {
    "new": (_P, _B, _U8),
    "free": (None, _P),
    "now": (_U64, _P),
    "run_to": (_I, _P, _U64),
    "reset": (None, _P, _U8),
    "resets": (_U32, _P),
    "reset_at": (_U64, _P),
    "reset_flags": (_U8, _P),
    "data": (_U8, _P, _U16),
    "poke": (None, _P, _U16, _U8),
    "flash": (_U16, _P, _U32),
    "set_flash": (None, _P, _U32, _U16),
    "boot_at": (None, _P, _U32),
    "pc": (_U32, _P),
    "to_main": (_I, _P),
    "asleep": (_I, _P),
    "watch": (None, _P, _I),
    "interrupts_off": (_U32, _P),
    "pin_in": (None, _P, _C, _I, _I),
    "pin_out": (_I, _P, _C, _I),
    "battery": (None, _P, _U32),
    "motor": (_D, _P, _I),
    "pwm_hz": (_D, _P),
    "tone_hz": (_D, _P),
    "tone_duty": (_D, _P),
    "wheel": (None, _P, _I, _D),
    "counts": (ctypes.c_int64, _P, _I),
    "encoder_glitch": (None, _P, _I),
    "uart_feed": (None, _P, _B, _N),
    "uart_take": (_N, _P, ctypes.POINTER(_U8), ctypes.POINTER(_U64), _N),
    "uart_busy": (_I, _P),
    "usb_power": (None, _P, _I),
    "usb_bus_reset": (None, _P),
    "usb_setup": (_I, _P, _B),
    "usb_out": (_I, _P, _U8, _B, _N),
    "usb_in": (_I, _P, _U8, ctypes.POINTER(_U8), _N),
    "i2c_speed": (None, _P, _D),
    "i2c_write": (_I, _P, _U8, _B, _N, _I),
    "i2c_read": (_I, _P, _U8, ctypes.POINTER(_U8), _N, _I),
    "i2c_wire": (_I, _P, _N),
    "i2c_abandon_read": (_I, _P, _U8),
}


class _I2CStats(ctypes.Structure):
    _fields_ = (
        ("transfers", _U64),
        ("bytes", _U64),
        ("refused", _U64),
        ("deaf", _U64),
        ("stretch_longest", _U32),
        ("stretch_shortest", _U32),
        ("stretch_total", _U64),
    )


class I2CStats(NamedTuple):
    transfers: int
    bytes: int
    refused: int
    """Addresses and bytes not acknowledged."""
    deaf: int
    """Addresses missed because the STOP before was still being handled."""
    stretch_longest: float
    """s."""
    stretch_shortest: float
    stretch_total: float


class Sent(NamedTuple):
    """A byte the firmware sent to the DWM1001."""

    at: float
    byte: int


class Report(NamedTuple):
    """The UWB block."""

    sequence: int
    age: int
    count: int
    place: bytes
    ranges: tuple[bytes, ...]
    """Each with its anchor's place, as the module's answer has them."""


def _load(path: Path) -> ctypes.CDLL:
    library = ctypes.CDLL(str(path))
    for name, (result, *arguments) in _FUNCTIONS.items():
        function = getattr(library, f"bench_{name}")
        function.restype, function.argtypes = result, arguments
    library.bench_i2c_stats.restype = None
    library.bench_i2c_stats.argtypes = [_P, ctypes.POINTER(_I2CStats)]
    return library


class CrashedError(Exception):
    """The simulated CPU ran into something that is no program."""


class Bench:
    """One robot's board. Closed by the fixture that made it."""

    def __init__(self, library: Path, elf: Path, *, mcusr: int = POWER_ON) -> None:
        self._library = _load(library)
        self._handle = self._library.bench_new(os.fsencode(elf), mcusr)
        assert self._handle, f"{elf} cannot be loaded"

    def close(self) -> None:
        if self._handle:
            self._library.bench_free(self._handle)
            self._handle = None

    def call(self, name: str, *arguments: object) -> int:
        """Any function of bench.h by its name without `bench_`."""
        return getattr(self._library, f"bench_{name}")(self._handle, *arguments)

    # time

    @property
    def cycles(self) -> int:
        return self.call("now")

    @property
    def now(self) -> float:
        return self.cycles / HZ

    def run(self, seconds: float) -> None:
        self.run_to(self.now + seconds)

    def run_to(self, time: float) -> None:
        if self.call("run_to", round(time * HZ)):
            raise CrashedError

    def run_until(self, condition: object, limit: float, step: float = 0.001) -> float:
        """Run until `condition()` holds and return the time; fails after `limit` seconds."""
        end = self.now + limit
        while not condition():
            assert self.now < end, f"not within {limit} s"
            self.run(step)
        return self.now

    # I2C, as services.balancer.i2c.I2CBus

    def write(self, address: int, data: bytes) -> None:
        self._check(self.call("i2c_write", address, bytes(data), len(data), 1), len(data))

    def read(self, address: int, count: int) -> bytes:
        data = (_U8 * count)()
        self._check(self.call("i2c_read", address, data, count, 1), count)
        return bytes(data)

    def write_read(self, address: int, data: bytes, count: int) -> bytes:
        self._check(self.call("i2c_write", address, bytes(data), len(data), 0), len(data))
        return self.read(address, count)

    def _check(self, result: int, expected: int) -> None:
        if result == -3:
            raise CrashedError
        if result in (-2, -4):
            raise OSError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))
        if result != expected:
            raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))

    def i2c_stats(self) -> I2CStats:
        """Since the last call."""
        stats = _I2CStats()
        self._library.bench_i2c_stats(self._handle, ctypes.byref(stats))
        times = (stats.stretch_longest / HZ, stats.stretch_shortest / HZ, stats.stretch_total / HZ)
        return I2CStats(stats.transfers, stats.bytes, stats.refused, stats.deaf, *times)

    # the firmware's layout

    def get(self, field: str, *, gap: float = GAP) -> bytes:
        """The bytes of a field of layout.h."""
        offset, size, _ = FIELDS[field]
        return self.get_at(offset, size, gap=gap)

    def get_at(self, offset: int, count: int, *, gap: float = GAP) -> bytes:
        self.write(CONSTANTS["ADDRESS"], bytes((offset,)))
        self.run(gap)
        data = self.read(CONSTANTS["ADDRESS"], count)
        self.run(gap)
        return data

    def number(self, field: str) -> int:
        return int.from_bytes(self.get(field), "little")

    def put(self, field: str, data: bytes, *, gap: float = GAP) -> None:
        self.write(CONSTANTS["ADDRESS"], bytes((FIELDS[field].offset,)) + data)
        self.run(gap)

    def drive(self, left: int, right: int) -> None:
        self.put("MOTORS", struct.pack("<2h", left, right))

    def encoders(self) -> tuple[int, int]:
        left, right = struct.unpack("<2h", self.get("ENCODERS"))
        return left, right

    def report(self) -> Report:
        """The UWB block in slices of 32 bytes at most, and again until all are of one report."""
        offset, size, _ = FIELDS["UWB"]
        for _ in range(5):
            data = b"".join(self.get_at(offset + at, min(32, size - at)) for at in range(0, size, 32))
            sequence, age, count = UWB_HEAD.unpack_from(data)
            if UWB_TAIL.unpack_from(data, size - 2)[0] == sequence:
                place = data[5:18]
                ranges = tuple(
                    data[18 + 7 * n : 25 + 7 * n] + data[46 + 13 * n : 59 + 13 * n]
                    for n in range(CONSTANTS["UWB_RANGES"])
                )
                return Report(sequence, age, count, place, ranges)
        raise AssertionError("no slice fitted another")

    # the board

    def motors(self) -> tuple[float, float]:
        """Signed duty of both motors, as the drivers see it."""
        return self.call("motor", LEFT), self.call("motor", RIGHT)

    def wheels(self, left: float, right: float) -> None:
        """Turn the wheels, counts/s."""
        self.call("wheel", LEFT, left)
        self.call("wheel", RIGHT, right)

    def counts(self) -> tuple[int, int]:
        """Where the wheels are."""
        return self.call("counts", LEFT), self.call("counts", RIGHT)

    def press(self, *, a: bool = False, b: bool = False, c: bool = False) -> None:
        """Hold these buttons down and no others."""
        for down, port, bit in ((a, b"B", 3), (b, b"D", 5), (c, b"B", 0)):
            self.call("pin_in", port, bit, int(not down))

    def leds(self) -> tuple[bool, bool, bool]:
        """Red, yellow, green as they shine."""
        red, yellow, green = (self.call("pin_out", port, bit) for port, bit in ((b"B", 0), (b"C", 7), (b"D", 5)))
        return red == 0, yellow == 1, green == 0

    def battery(self, volts: float) -> None:
        self.call("battery", round(volts * 1000 / 3))

    # the DWM1001's end of the line

    def feed(self, data: bytes) -> None:
        """The module says something, from now on."""
        self.call("uart_feed", data, len(data))

    def sent(self) -> list[Sent]:
        """What the firmware has said to the module since the last call."""
        data, times = (_U8 * 4096)(), (_U64 * 4096)()
        count = self.call("uart_take", data, times, 4096)
        return [Sent(times[i] / HZ, data[i]) for i in range(count)]

    def sent_bytes(self) -> bytes:
        return bytes(item.byte for item in self.sent())

    def await_request(self, limit: float = 0.15) -> bytes:
        """Run until the firmware has said something and stopped; returns it."""
        said = b""
        end = self.now + limit
        while True:
            new = self.sent_bytes()
            said += new
            if said and not new:
                return said
            assert self.now < end, f"no request within {limit} s"
            self.run(0.0005)
