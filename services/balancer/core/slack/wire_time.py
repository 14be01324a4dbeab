"""The durations of transfers on this bus, learned from those of the control step.

A Pi's SCL is its core clock over a divider that is set once, so it may be two thirds or less of what was asked for, and
change while it runs (docs/reference/robot/i2c-bus.md). Each control step writes an index to the ATmega, reads the IMU,
and reads the ATmega's encoders: transfers whose bytes are known. Their times tell the period of SCL, how long the
ATmega holds it with each byte, and what a transfer takes besides.
"""

from typing import NamedTuple

from services.balancer.core.devices import balboa, imu

BITS_PER_BYTE = 9
"""Eight bits of data and the acknowledge."""
BITS_PER_TRANSFER = 2
"""START and STOP (or repeated START) take about a bit each."""
HOLD_S = 25e-6
"""Seconds by which the ATmega is assumed to lengthen each byte before this is measured. The value is within the range
seen in the simulator (firmware/README.md)."""
LONGEST_HOLD_S = 40e-6
"""The most seconds by which the ATmega lengthens a byte."""
SCL_HZ = 100e3
"""SCL as provisioning asks for it (`i2c_arm_baudrate`)."""
SLOWEST_HZ = 40e3
"""SCL before it was measured: the lowest of a Pi that others saw (raspberrypi/linux 5434)."""

LONGEST = 32
"""Bytes of a transfer outside of the control step, index or control byte included: anything larger goes in slices."""

_UP, _DOWN = 0.12, 0.02
"""Largest relative steps of an estimate. One sample in seven may be longer than the rest, by whatever, as where
another process ran in between, and the estimate stays at the others; a clock that drops is followed in some ticks."""

_LEAST = 0.005, 0.12
"""Largest relative steps of an estimate that stays at the shortest samples. It follows a clock that drops to 60 %
within a second."""

_QUICKEST_BIT_S = 1 / 1e6
_IMU_BITS = 2 * BITS_PER_TRANSFER + BITS_PER_BYTE * (3 + imu.BLOCK)
_SELECT_BYTES = 2
"""The ATmega's address and the index."""
_SELECT_BITS = BITS_PER_TRANSFER + BITS_PER_BYTE * _SELECT_BYTES


class Transfer(NamedTuple):
    """`data` is written; where `reads` is not 0, STOP, a pause, and that many bytes are read."""

    address: int
    data: bytes
    reads: int = 0


class Room(NamedTuple):
    """The bytes that a transfer may have to fit a time; at most `LONGEST`, below 1 where none fits."""

    read: int
    """Bytes read from the ATmega."""
    write: int
    """Bytes written to the ATmega, without the index."""
    send: int
    """Bytes written to a device other than the ATmega."""


WHOLE = Room(LONGEST, LONGEST - 1, LONGEST)
"""Room for every transfer that slack tasks make."""


_SHORTEST_S = 1e-7
"""Shortest duration of a sample: the difference of two times may be zero."""


class TypicalTime:
    """An estimate of a usual duration, s: near the upper end of most samples, whatever the few longest ones are."""

    def __init__(self, seconds: float, up: float = _UP, down: float = _DOWN) -> None:
        """`up` and `down` are the largest relative steps."""
        self.seconds = seconds
        self._up, self._down = up, down

    def add(self, seconds: float) -> None:
        change = max(_SHORTEST_S, seconds) / self.seconds - 1.0
        self.seconds *= 1.0 + max(-self._down, min(self._up, change))


class WireTime:
    """Estimates how long transfers take, from the control step's own."""

    def __init__(self, scl: float = SLOWEST_HZ) -> None:
        """`scl` is what to expect before anything was measured, Hz."""
        self._select = TypicalTime(_SELECT_BITS / scl + _SELECT_BYTES * HOLD_S)
        self._imu = TypicalTime(_IMU_BITS / scl)
        self._hold = TypicalTime(HOLD_S)
        self._least_select = TypicalTime(self._select.seconds, *_LEAST)
        self._least_imu = TypicalTime(self._imu.seconds, *_LEAST)

    @property
    def scl(self) -> float:
        """SCL as the shortest transfers show it, Hz: another process can only make one longer."""
        held = _SELECT_BYTES * min(LONGEST_HOLD_S, self._hold.seconds)
        wire = self._least_imu.seconds - self._least_select.seconds + held
        return (_IMU_BITS - _SELECT_BITS) / max(wire, (_IMU_BITS - _SELECT_BITS) * _QUICKEST_BIT_S)

    @property
    def bit_s(self) -> float:
        """The period of SCL as most transfers have it, for plans."""
        held = _SELECT_BYTES * self._hold.seconds
        return max(_QUICKEST_BIT_S, (self._imu.seconds - self._select.seconds + held) / (_IMU_BITS - _SELECT_BITS))

    @property
    def call_s(self) -> float:
        """Return the duration of a transfer besides its bytes, s: the kernel, Python."""
        return max(0.0, self._imu.seconds - _IMU_BITS * self.bit_s)

    @property
    def byte_s(self) -> float:
        """Return the duration of a byte to or from the ATmega, s."""
        return BITS_PER_BYTE * self.bit_s + self._hold.seconds

    def learn(self, select: float, sample: float, count: int, motion: float) -> None:
        """Learn from the durations of a tick's transfers, s: the index written to the ATmega, the IMU's sample, and
        a read of `count` bytes from the ATmega."""
        for estimate in (self._select, self._least_select):
            estimate.add(select)
        for estimate in (self._imu, self._least_imu):
            estimate.add(sample)
        wire = (BITS_PER_TRANSFER + BITS_PER_BYTE * (1 + count)) * self.bit_s
        self._hold.add((motion - self.call_s - wire) / (1 + count))

    def duration(self, transfer: Transfer) -> float:
        """Return the duration of a transfer, s: on the wire, and the pauses before and between writing and reading."""
        parts = 2 if transfer.reads else 1
        size = parts + len(transfer.data) + transfer.reads
        each = BITS_PER_TRANSFER * self.bit_s + self.call_s
        if transfer.address == balboa.ADDRESS:
            return parts * (balboa.PAUSE_S + each) + size * self.byte_s
        return parts * each + size * BITS_PER_BYTE * self.bit_s

    def room(self, seconds: float) -> Room:
        """Return the bytes that fit into `seconds`."""
        each, byte = BITS_PER_TRANSFER * self.bit_s + self.call_s, self.byte_s
        return Room(
            read=min(LONGEST, int((seconds - 2 * (each + balboa.PAUSE_S)) / byte) - 3),
            write=min(LONGEST - 1, int((seconds - each - balboa.PAUSE_S) / byte) - 2),
            send=min(LONGEST, int((seconds - each) / (BITS_PER_BYTE * self.bit_s)) - 1),
        )
