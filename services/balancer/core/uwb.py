"""The ATmega's UWB block: decoded, and read in slices that each fit the slack of one tick.

    head (12 bytes, often): a new sequence number? -> four slices -> both sequence numbers equal? -> a report

The sequence number stands at both ends of the block. Where a report came in between the slices they differ, what was
read is torn, and it is read again. The ATmega asks the module every 100 ms, so there is no need to look before the next
report can be there.
"""

import enum
import struct

from services.balancer.core import balboa
from services.balancer.core.transfers import LONGEST, Transfer, read
from swarm.errors import RemoteError
from swarm.messages import Uwb, UwbRange

PERIOD_S = 0.100
"""Of the ATmega's polls."""
LOOK_S = 0.020
"""Between looks once a report may be there."""
TELL_S = 1.0
"""Without reports the state of the line is told this often."""
TORN_LIMIT = 3
"""Tries in a row to read one report."""
FAILURES = 3
"""Tries in a row to read one slice: what was read of a report before it still counts."""
_RESET_JUMP = 1000
"""Reports that cannot have been missed: the ATmega was reset and counts from 1 again."""

_HEAD = struct.Struct("<HHB")
_PLACE = struct.Struct("<iiiB")
_RANGE = struct.Struct("<HIB")
_TAIL = struct.Struct("<H")
_RANGES = _HEAD.size + _PLACE.size
_RECORD = _RANGE.size + _PLACE.size
_SLICES = tuple(read(balboa.UWB + at, min(LONGEST, balboa.UWB_SIZE - at)) for at in range(0, balboa.UWB_SIZE, LONGEST))
_LOOK = read(balboa.UWB_STATE, balboa.PROGRESS_SIZE)


class UwbState(enum.IntEnum):
    """UWB_STATE: what became of the last poll."""

    SILENT = 0
    OK = 1
    REFUSED = 2
    BROKEN = 3
    PAUSED = 4


def check(block: bytes) -> int:
    """The sequence number of a whole block, 0 where it was torn. Raises `RemoteError` where it has another length."""
    if len(block) != balboa.UWB_SIZE:
        raise RemoteError(f"ATmega: {len(block)} bytes of the UWB block instead of {balboa.UWB_SIZE}")
    (sequence,) = _TAIL.unpack_from(block, balboa.UWB_SIZE - _TAIL.size)
    return sequence if sequence == _HEAD.unpack_from(block)[0] else 0


def decode(block: bytes, t: float, progress: balboa.UwbProgress, bad: int, sequence: int, lost: int) -> Uwb:
    """The message of a block that `check` accepted, selected at `t`; `bad`, `sequence` and `lost` go into it.

    Raises `RemoteError` where the block says what the firmware lets no report say.
    """
    _, age, count = _HEAD.unpack_from(block)
    x, y, z, quality = _place(block, _HEAD.size)
    ranges = []
    for n in range(min(count, balboa.UWB_RANGES)):
        at = _RANGES + _RECORD * n
        address, distance, certain = _RANGE.unpack_from(block, at)
        ranges.append(UwbRange(f"{address:04X}", distance / 1e3, _percent(certain), *_place(block, at + _RANGE.size)))
    state = _name(progress.uwb_state)
    return Uwb(t, state, progress.uwb_error, bad, sequence, lost, age / 1e3, x, y, z, quality, count, tuple(ranges))


def _place(block: bytes, at: int) -> tuple[float, float, float, int]:
    x, y, z, quality = _PLACE.unpack_from(block, at)
    return x / 1e3, y / 1e3, z / 1e3, _percent(quality)


def _percent(value: int) -> int:
    if value > 100:
        raise RemoteError(f"ATmega: a quality of {value} % in the UWB block")
    return value


def _name(state: int) -> str:
    try:
        return UwbState(state).name.lower()
    except ValueError:
        raise RemoteError(f"ATmega: UWB_STATE is {state}, there is none") from None


class UwbReader:
    """A slack task: reads each report once, and tells how the line is when there are none.

    `progress` serves others too: it is the newest look at what the ATmega is doing.
    """

    def __init__(self, now: float) -> None:
        self.progress: balboa.UwbProgress | None = None
        self.news: Uwb | None = None
        """What is to be told; whoever takes it sets None."""
        self._look_at = now
        self._tell_at = now + TELL_S
        self._slices = bytearray()
        self._slice = -1
        """The slice that is read next; -1 = none, look."""
        self._torn = self._failures = 0
        self._block_at = now
        self._seen = 0
        """The ATmega's number of the newest report that was read."""
        self._last_bad = 0
        self._bad = 0
        self._last = Uwb(now, "silent", 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0, 0, ())

    def next(self, now: float) -> Transfer | None:
        """See `SlackTask`."""
        if self._slice >= 0:
            return _SLICES[self._slice]
        return _LOOK if now >= self._look_at else None

    def take(self, data: bytes, now: float) -> None:
        """See `SlackTask`."""
        if self._slice < 0:
            self._looked(balboa.decode_progress(data), now)
            return
        self._failures = 0
        if self._slice == 0:
            self._block_at = now
            self._slices.clear()
        self._slices += data
        self._slice += 1
        if self._slice == len(_SLICES):
            self._slice = -1
            self._whole(bytes(self._slices), now)

    def fail(self, error: OSError, now: float) -> None:
        """See `SlackTask`."""
        del error  # the control loop meets it too, and names it
        self._failures += 1
        if self._slice < 0 or self._failures >= FAILURES:
            self._slice, self._look_at, self._failures = -1, now + LOOK_S, 0

    def restart(self) -> None:
        """The ATmega was reset or was away."""
        self._slice, self._seen, self._last_bad, self._bad, self._torn = -1, 0, 0, 0, 0

    def _looked(self, progress: balboa.UwbProgress, now: float) -> None:
        self._look_at = now + LOOK_S
        if progress.uwb_sequence == 0 and self._seen:
            self.restart()
        self._bad += (progress.uwb_bad - self._last_bad) % 256
        self._last_bad = progress.uwb_bad
        self.progress = progress
        if progress.uwb_sequence not in (0, self._seen):
            self._slice = 0
        elif now >= self._tell_at:
            self._tell_at = now + TELL_S
            age = min(65.535, self._last.age + now - self._last.t) if self._last.sequence else 0.0
            last = self._last
            self.news = Uwb(
                now, _name(progress.uwb_state), progress.uwb_error, self._bad, last.sequence, last.lost, age,
                last.x, last.y, last.z, last.quality, last.count, last.ranges,
            )  # fmt: skip

    def _whole(self, block: bytes, now: float) -> None:
        sequence = check(block)
        if sequence == 0:
            self._torn += 1
            if self._torn < TORN_LIMIT:
                self._slice = 0
            return
        self._torn = 0
        # 0 is left out when the ATmega's number wraps.
        step = (sequence - self._seen) % 0xFFFF if self._seen else 1
        lost = step - 1 if 0 < step < _RESET_JUMP else 0
        self._seen = sequence
        last = self._last
        assert self.progress is not None
        self._last = self.news = decode(
            block, self._block_at, self.progress, self._bad, last.sequence + 1, last.lost + lost
        )
        self._tell_at = now + TELL_S
        self._look_at = max(now + LOOK_S, self._block_at - self._last.age + PERIOD_S)
