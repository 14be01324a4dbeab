"""The ATmega's UWB block: decoded, and read in pieces that each fit what is left of a tick.

    a new number in STATUS -> head, place and ranges of the anchors in sight -> places not known yet -> a report

The number of the newest report comes with the encoders in every tick, so nothing is read to find that nothing is new.
The report is frozen when its first piece is read, until the first piece of the next. Where an anchor stands changes
rarely: its place is read when its address is new, and again now and then. That leaves 46 of the block's 100 bytes.
"""

import enum
import struct
from collections import deque
from collections.abc import Iterator

from services.balancer.core.devices import balboa
from services.balancer.core.slack.transfers import piece
from services.balancer.core.slack.wire_time import WHOLE, Room, Transfer
from swarm.errors import RemoteError
from swarm.messages import Uwb, UwbRange

PERIOD_S = 0.100
"""Period of the ATmega's polls, s."""
TELL_S = 1.0
"""Seconds between reads of the line's state. Without reports the state is also told this often."""
TORN_LIMIT = 3
"""Tries in a row to read one report."""
FAILURES = 3
"""Tries in a row to read one piece: what was read of a report before it still counts."""
REFRESH = 10
"""Reports after which the place of one more anchor is read again."""
RECENT, BEHIND = 50, 8
"""UWB is behind if BEHIND of the last RECENT reports were not read in time."""
PLACES = 64
"""Anchors whose places are kept, at most."""
_RESET_JUMP = 1000
"""Reports that cannot have been missed: the ATmega was reset and counts from 1 again."""

_HEAD = struct.Struct("<HHB")
_PLACE = struct.Struct("<iiiB")
_RANGE = struct.Struct("<HIB")
_RANGES = _HEAD.size + _PLACE.size
_PLACES = _RANGES + balboa.UWB_RANGES * _RANGE.size
"""Offsets in the block at which the ranges begin, and the places of their anchors."""
_LOOK = balboa.UWB_STATE


class UwbState(enum.IntEnum):
    """UWB_STATE: what became of the last poll."""

    SILENT = 0
    OK = 1
    REFUSED = 2
    BROKEN = 3
    PAUSED = 4


def check(block: bytes) -> int:
    """Return the sequence number of a block, 0 where there is no report in it, or not all of one: the ATmega was reset
    while it was read. Raises `RemoteError` where it has another length."""
    if len(block) != balboa.UWB_SIZE:
        raise RemoteError(f"ATmega: {len(block)} bytes of the UWB block instead of {balboa.UWB_SIZE}")
    sequence, _, count = _HEAD.unpack_from(block)
    records = (_RANGES + _RANGE.size * n for n in range(min(count, balboa.UWB_RANGES)))
    whole = all(any(block[at : at + _RANGE.size]) for at in records)
    return sequence if whole else 0


def decode(block: bytes, t: float, bad: int, sequence: int, lost: int) -> Uwb:
    """Return the message of a block that `check` accepted, selected at `t`; `bad`, `sequence` and `lost` go into it.

    Raises `RemoteError` where the block says what the firmware lets no report say.
    """
    _, age, count = _HEAD.unpack_from(block)
    x, y, z, quality = _place(block, _HEAD.size)
    ranges = []
    for n in range(min(count, balboa.UWB_RANGES)):
        address, distance, certain = _RANGE.unpack_from(block, _RANGES + _RANGE.size * n)
        place = _place(block, _PLACES + _PLACE.size * n)
        ranges.append(UwbRange(f"{address:04X}", distance / 1e3, _percent(certain), *place))
    return Uwb(t, _name(UwbState.OK), 0, bad, sequence, lost, age / 1e3, x, y, z, quality, count, tuple(ranges))


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
    """A slack task: reads each report once, and tells how the line is when there are none."""

    def __init__(self, now: float) -> None:
        self.progress: balboa.UwbProgress | None = None
        """The newest look at the line's state."""
        self.news: Uwb | None = None
        """The message to publish. The caller that publishes it sets it to None."""
        self._look_at = now
        self._tell_at = now + TELL_S
        self._newest = 0
        """The ATmega's number of its newest report, modulo 16."""
        self._look = b""
        """The bytes of the line's state that were read so far."""
        self._block = bytearray(balboa.UWB_SIZE)
        self._spans: Iterator[tuple[int, int]] = iter(())
        """What is to be read of the report under way after `_span`."""
        self._span: tuple[int, int] | None = None
        """What is to be read next, as offsets from and to; None where no report is under way."""
        self._places: dict[bytes, bytes] = {}
        """The place of each anchor by its address, both as bytes of the block."""
        self._reports = 0
        self._missed: deque[bool] = deque(maxlen=RECENT)
        self._torn = self._failures = 0
        self._block_at = now
        self._seen = 0
        """The ATmega's number of the newest report that was read."""
        self._last_bad = 0
        self._bad = 0
        self._last = Uwb(now, "silent", 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0, 0, ())

    @property
    def behind(self) -> bool:
        """Whether reports come faster than they can be read."""
        return sum(self._missed) >= BEHIND

    def notice(self, newest: int) -> None:
        """Take the number of the ATmega's newest report, modulo 16, as each tick finds it."""
        self._newest = newest

    def next(self, now: float, room: Room = WHOLE) -> Transfer | None:
        if self._span is None:
            if now >= self._look_at:
                return piece(_LOOK + len(self._look), _LOOK + balboa.PROGRESS_SIZE, room)
            if self._newest == self._seen & 15:
                return None
            self._begin()
        assert self._span is not None
        return piece(*self._span, room)

    def take(self, data: bytes, now: float) -> None:
        self._failures = 0
        if self._span is None:
            self._look += data
            if len(self._look) >= balboa.PROGRESS_SIZE:
                look, self._look = self._look, b""
                self._looked(balboa.decode_progress(look), now)
            return
        at, end = self._span
        if at == balboa.UWB:
            self._block_at = now
        self._block[at - balboa.UWB : at - balboa.UWB + len(data)] = data
        at += len(data)
        self._span = (at, end) if at < end else next(self._spans, None)
        if self._span is None:
            self._whole(bytes(self._block))

    def fail(self, error: OSError, now: float) -> None:
        del error  # the control loop meets it too, and names it
        self._failures += 1
        if self._span is None:
            self._look_at, self._look = now + PERIOD_S, b""
        elif self._failures >= FAILURES:
            self._span, self._failures = None, 0

    def restart(self) -> None:
        """The ATmega was reset or was away."""
        self._span, self._seen, self._last_bad, self._bad, self._torn = None, 0, 0, 0, 0
        self._look = b""
        self._missed.clear()

    def _begin(self) -> None:
        self._spans = self._report()
        self._span = next(self._spans)

    def _report(self) -> Iterator[tuple[int, int]]:
        """Yield the spans of a report to read, one after the other."""
        block = self._block
        yield balboa.UWB, balboa.UWB + _RANGES
        count = min(block[_HEAD.size - 1], balboa.UWB_RANGES)
        if count:
            yield balboa.UWB + _RANGES, balboa.UWB + _RANGES + count * _RANGE.size
        again = self._reports // REFRESH % count if count and self._reports % REFRESH == 0 else -1
        self._reports += 1
        for n in range(count):
            address = bytes(block[_RANGES + n * _RANGE.size :][:2])
            begin, end = _PLACES + n * _PLACE.size, _PLACES + (n + 1) * _PLACE.size
            if n == again or address not in self._places:
                yield balboa.UWB + begin, balboa.UWB + end
                if len(self._places) >= PLACES:
                    self._places.clear()
                self._places[address] = bytes(block[begin:end])
            else:
                block[begin:end] = self._places[address]

    def _looked(self, progress: balboa.UwbProgress, now: float) -> None:
        self._look_at = now + TELL_S
        if self._newest == self._seen & 15 and now >= self._block_at + RECENT * PERIOD_S:
            self._missed.clear()  # no report has come since: what was missed before tells nothing of the bus now
        self._bad += (progress.uwb_bad - self._last_bad) % 256
        self._last_bad = progress.uwb_bad
        self.progress = progress
        if now >= self._tell_at:
            self._tell_at = now + TELL_S
            age = min(65.535, self._last.age + now - self._last.t) if self._last.sequence else 0.0
            last = self._last
            self.news = Uwb(
                now,
                _name(progress.uwb_state),
                progress.uwb_error,
                self._bad,
                last.sequence,
                last.lost,
                age,
                last.x,
                last.y,
                last.z,
                last.quality,
                last.count,
                last.ranges,
            )

    def _whole(self, block: bytes) -> None:
        sequence = check(block)
        if sequence == 0:
            self._torn += 1
            if self._torn >= TORN_LIMIT:
                self.restart()
                self._newest = 0
            return
        self._torn = 0
        # 0 is left out when the ATmega's number wraps.
        step = (sequence - self._seen) % 0xFFFF if self._seen else 1
        lost = step - 1 if 0 < step < _RESET_JUMP else 0
        self._missed.extend([True] * min(lost, RECENT) + [False])
        self._seen = sequence
        last = self._last
        self._last = self.news = decode(block, self._block_at, self._bad, last.sequence + 1, last.lost + lost)
        self._tell_at = self._block_at + TELL_S
