"""The flow of bulk over one link: in fragments, and with as many bytes under way as the link needs.

**Fragments.** A message that is larger than a fragment is cut into FRAGMENT frames and put together again at the
other end. The fragments of one channel come in order and one message at a time; those of different channels are
interleaved. A link loses nothing while it lives, so a gap is a defect of the sender and ends the connection; what is
incomplete when the link ends is gone. The receiver holds a bounded number of bytes for each peer, whatever the peer
announces.

**Window.** The kernel takes 50 kB for an RFCOMM socket, 650 ms at its 78 kB/s, and nothing can overtake what it
holds. So the other end acknowledges bytes (ACK: taken off the stream so far), and bulk leaves only while the bytes
under way are fewer than a window. Sync and control are let `SYNC_EXTRA` bytes further, so that a flood of them cannot
fill the queue either. A stop is never held back.

The window looks for the knee (Jain 1989): the smallest one that still gives nearly all of the link's rate, since above
it bytes only wait. While bulk keeps it full, a window of 6 % more and one of 10 % less are tried in turn, and the
change is kept where the rate says so (as in PCC, Dong et al. 2015). Round trips are no guide here: with the thesis'
jitter (10 ms each way, in order) they grow by half as soon as a link is busy, without a byte in any queue, and a window
steered by them shrank to its floor.

**Pace.** A window leaves evenly over a round trip (Aggarwal 2000; RFC 9002, section 7.7), write by write. On a robot
that passes messages on, bulk comes by the piece of six fragments. Without a pace all six would stand in the socket at
once, and a stop would wait for them on each link of its way.
"""

import struct
from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

from services.mesh.core.link.round_trips import RoundTrips
from services.mesh.core.wire import frames
from swarm.errors import FrameError

FRAGMENT = 328
"""Bytes of a message in one fragment. A write ends when it holds so many with bulk among them: 4.4 ms at Bluetooth's
78 kB/s with all headers. What is handed over cannot be overtaken, and smaller writes cost more work and more of the
radio's time."""

MAX_INCOMPLETE = 64
"""Messages of one peer that may be incomplete at the same time."""

MAX_INCOMPLETE_BYTES = 3 * 1024 * 1024 // 2
"""Announced bytes of the incomplete messages of one peer."""

INCOMPLETE_TIMEOUT = 30.0
"""Seconds without a fragment after which an incomplete message is dropped."""

_LAST = 0x8000
_HEAD = struct.Struct("<HH")
_FIRST = struct.Struct("<HHI")


class Fragment(NamedTuple):
    """One part of a message."""

    channel: int
    number: int
    """Counts the parts of a message from 0."""
    last: bool
    total: int
    """Bytes of the whole message; told with number 0 only, 0 otherwise."""
    data: bytes


def encode_fragment(fragment: Fragment) -> bytes:
    """Encode a FRAGMENT frame."""
    marked = fragment.number | (_LAST if fragment.last else 0)
    if fragment.number == 0:
        head = _FIRST.pack(fragment.channel, marked, fragment.total)
    else:
        head = _HEAD.pack(fragment.channel, marked)
    return frames.encode(frames.FRAGMENT, frames.BULK, head + fragment.data)


def decode_fragment(body: bytes) -> Fragment:
    """Decode the body of a FRAGMENT frame. Raises `FrameError`."""
    if len(body) < _HEAD.size:
        raise FrameError(f"FRAGMENT of {len(body)} bytes: no channel and index")
    channel, number = _HEAD.unpack_from(body)
    size, total = _HEAD.size, 0
    last, number = number & _LAST != 0, number & ~_LAST
    if number == 0:
        size = _FIRST.size
        if len(body) < size:
            raise FrameError(f"FRAGMENT of {len(body)} bytes: the first one tells the length of the message")
        total = _FIRST.unpack_from(body)[2]
        if not 1 <= total <= frames.MAX_MESSAGE:
            raise FrameError(f"FRAGMENT of a message of {total} bytes: 1 to {frames.MAX_MESSAGE} are allowed")
    if len(body) == size:
        raise FrameError("FRAGMENT without a byte of the message")
    return Fragment(channel, number, last, total, body[size:])


@dataclass(eq=False)
class _Incomplete:
    """What has come of one message."""

    total: int
    data: bytearray = field(default_factory=bytearray)
    """What has come. Not a list of fragments: each of a few bytes would cost fifty."""
    next: int = 0
    heard: float = 0.0


class Reassembly:
    """The incomplete messages of one peer, on one connection."""

    def __init__(self, counters: Counter[str]) -> None:
        """Counts in `incomplete` the messages it drops."""
        self._counters = counters
        self._messages: dict[int, _Incomplete] = {}
        self._bytes = 0

    def add(self, fragment: Fragment, now: float) -> bytes | None:
        """Take a fragment; the whole message where it was the last one. Raises `FrameError`."""
        if fragment.number == 0:
            self.drop(fragment.channel)
            self.expire(now)
            if len(self._messages) >= MAX_INCOMPLETE or self._bytes + fragment.total > MAX_INCOMPLETE_BYTES:
                self._counters["incomplete"] += 1
                return None
            self._messages[fragment.channel] = _Incomplete(fragment.total)
            self._bytes += fragment.total
        message = self._messages.get(fragment.channel)
        if message is None:
            return None  # its beginning was not taken, or it was dropped since
        if fragment.number != message.next:
            raise FrameError(f"FRAGMENT {fragment.number} where {message.next} was to come")
        message.data += fragment.data
        message.next += 1
        message.heard = now
        size = len(message.data)
        if size > message.total or fragment.last != (size == message.total):
            raise FrameError(f"FRAGMENT: {size} bytes of a message of {message.total}")
        if not fragment.last:
            return None
        del self._messages[fragment.channel]
        self._bytes -= message.total
        return bytes(message.data)

    def drop(self, channel: int) -> None:
        """Forget what is incomplete on a channel: it begins anew, or stands for another key now."""
        if (message := self._messages.pop(channel, None)) is not None:
            self._bytes -= message.total
            self._counters["incomplete"] += 1

    def expire(self, now: float) -> None:
        """Forget what got no fragment for too long."""
        for channel in [channel for channel, each in self._messages.items() if now >= each.heard + INCOMPLETE_TIMEOUT]:
            self.drop(channel)


FIRST_WINDOW = 5632
"""Bytes; the bandwidth-delay product of the thesis' links, 78 kB/s x 60 ms, a write, and the delay of an ACK.
Where several links in a row begin too small, none of them sees the backlog that would make it grow."""

MIN_WINDOW = 1024
MAX_WINDOW = 32 * 1024
"""Less than the socket's buffer, which would limit the rate otherwise."""

SYNC_EXTRA = 8 * 1024

LARGER, SMALLER = 1.06, 0.9
"""What is tried; a larger window has room for another fragment at least."""

FASTER = 1.25
"""What is tried next where a larger window was kept."""

GAIN, LOSS = 1.03, 0.95
"""A larger window is kept where the rate becomes more than this times what it was, a smaller one likewise."""

COLLAPSE = 0.6
"""Share of the rate below which the link has become slower; the window follows at once."""

SLACK = 0.07
"""Seconds by which a round trip may exceed twice the smallest one; above, bytes wait whatever the rate says, as on a
link much slower than expected. Jitter stays far below it. A longer round trip is not smoothed either: a link that was
silent for seconds is not to keep a slow pace for seconds afterwards."""

RELIEF = 0.7
"""Factor of the window then, once a round trip."""

PACE = 0.9
"""Share of the window that leaves in a smoothed round trip. It is below one, so that bulk comes to the link no faster
than the link carries it. What has to wait then waits here, where a stop overtakes it."""

LATE = 0.001
"""Seconds by which a write may leave late without a delay of those after it."""

PERIOD = 0.1
"""Seconds over which a rate is measured at least;"""

ROUND_TRIPS = 8
"""and in round trips."""

KEPT_RATES = 5
"""Periods whose median rate a trial is compared with."""

REST = 4
"""Periods between two trials."""

FIRST_REST = 3
"""Periods before the first one: what begins speeds up by itself, which must not be taken for the merit of a trial."""

ACK_EVERY = 512
"""Bytes of bulk after which an ACK is sent by itself; an ACK that is due also rides with any other frame."""

ACK_AT_LATEST = 2 * ACK_EVERY
"""Bytes of anything after which it is."""

_ACK = struct.Struct("<I")
_MODULUS = 1 << 32


def encode_ack(count: int) -> bytes:
    """Encode an ACK frame; `count` is that of all bytes so far."""
    return frames.encode(frames.ACK, frames.CONTROL, _ACK.pack(count % _MODULUS))


def decode_ack(body: bytes) -> int:
    """Return the count of an ACK frame, modulo 2^32. Raises `FrameError`."""
    if len(body) != _ACK.size:
        raise FrameError(f"ACK of {len(body)} bytes: it has {_ACK.size}")
    count: int = _ACK.unpack(body)[0]
    return count


class Receipts:
    """The receiving side of one connection: which bytes are to be acknowledged."""

    def __init__(self) -> None:
        self.taken = 0
        """Bytes taken off the stream so far."""
        self.bulk = False
        """Whether bulk was among those not acknowledged yet."""
        self._acknowledged = 0

    def due(self) -> bool:
        """Return whether an ACK is worth a write of its own."""
        owed = self.taken - self._acknowledged
        return owed >= ACK_AT_LATEST or (self.bulk and owed >= ACK_EVERY)

    def take(self, *, at_once: bool) -> int | None:
        """Return the bytes to acknowledge beside other frames; None where they are too few. `at_once` acknowledges
        any number."""
        if self.taken - self._acknowledged >= (1 if at_once else ACK_EVERY):
            self._acknowledged = self.taken
            self.bulk = False
            return self.taken
        return None


class SendWindow:
    """The sending side of one connection."""

    def __init__(self) -> None:
        self.limit = float(FIRST_WINDOW)
        """Bytes that may be under way before bulk has to wait."""
        self.sent = 0
        self.acknowledged = 0
        self.next_bulk = 0.0
        """The time before which no bulk leaves, as the pace has it."""
        self._marks: list[tuple[int, float]] = []
        """For each write with bulk in it: the count of bytes at its end, and its time, s."""
        self._round_trips = RoundTrips()
        self._relieved = 0.0
        self._since: float | None = None
        """Since when bulk has waited for the window or its pace, or since the last measurement of the rate."""
        self._from = 0
        self._trial = 0.0
        """The factor that is being tried; 0 = none."""
        self._trial_until = 0.0
        """The time from which a trial ends when no bulk waits, since it cannot be judged then."""
        self._next_trial = LARGER
        self._rest = FIRST_REST
        self._rates: list[float] = []
        """The last rates with the window as it was before the trial, bytes/s."""

    @property
    def in_flight(self) -> int:
        """Bytes written that the other end has not acknowledged."""
        return self.sent - self.acknowledged

    def free(self, size: int, now: float) -> float:
        """Return how many bytes may still leave when `size` are about to be written. Bulk needs a positive number, and
        there is none before `next_bulk`; sync and control may make it as low as -`SYNC_EXTRA`."""
        free = self.limit - (self.sent - self.acknowledged) - size
        return free if now >= self.next_bulk else min(free, 0.0)

    def wrote(self, size: int, now: float, *, bulk: bool, waits: bool) -> None:
        """Note that `size` bytes were written. `bulk`: there was bulk among them; `waits`: more bulk waits."""
        self.sent += size
        if bulk:
            self._marks.append((self.sent, now))
            # Bulk may leave before its time, as its share beside sync. The next bulk then waits for the time of this
            # write alone, not for that of all such writes.
            due = max(min(self.next_bulk, now), now - LATE)
            self.next_bulk = due + size * self._round_trips.smoothed / (PACE * self.limit)
        if not waits:
            self._since = None
            if self._trial and now >= self._trial_until:
                self._end_trial(self._trial)
        elif self._since is None and self.free(0, now) <= 0.0:
            self._begin(now)

    def on_ack(self, count: int, now: float) -> None:
        """The other end has taken so many bytes, modulo 2^32. Raises `FrameError`."""
        new = (count - self.acknowledged) % _MODULUS
        if new > self.in_flight:
            raise FrameError(f"ACK of {new} bytes where {self.in_flight} are under way")
        # A write that ends less than `ACK_EVERY` bytes after the last acknowledgement gets none of its own. It is
        # acknowledged with what follows it, a heartbeat mostly, and that time says nothing of the link.
        at_once = self.acknowledged + ACK_EVERY
        self.acknowledged += new
        marked = None
        while self._marks and self._marks[0][0] <= self.acknowledged:
            end, written = self._marks.pop(0)
            if end >= at_once:
                marked = written
        if marked is not None:
            self._on_round_trip(now - marked, now)
        period = max(PERIOD, ROUND_TRIPS * self._round_trips.smoothed)
        if self._since is not None and now >= self._since + period:
            if now < self._since + 2.0 * period:  # else the radio was elsewhere, which says nothing of the window
                self._judge((self.acknowledged - self._from) / (now - self._since))
            self._begin(now)
            if self._trial:
                self._trial_until = now + 2.0 * period

    def _on_round_trip(self, rtt: float, now: float) -> None:
        too_long = self._is_too_long(rtt)
        self._round_trips.add(rtt, now, usual=not too_long)
        if self._is_too_long(self._round_trips.smoothed):
            # The first round trips had nothing to be compared with. A shorter one shows now that they were too long.
            self._round_trips.smoothed = rtt
        if too_long and now >= self._relieved + rtt:
            self._relieved = now
            self._set(self.limit * RELIEF)
            self._rest, self._trial, self._since = REST, 0.0, None

    def _is_too_long(self, rtt: float) -> bool:
        return rtt > 2.0 * self._round_trips.least + SLACK

    def _begin(self, now: float) -> None:
        """Measure the rate from now on."""
        self._since, self._from = now, self.acknowledged

    def _judge(self, rate: float) -> None:
        """Judge the window by the `rate` of a period during which bulk waited, bytes/s."""
        # The median, not the mean: a gap between two messages would let a larger window look better than it is.
        usual = sorted(self._rates)[len(self._rates) // 2] if self._rates else 0.0
        if self._trial:
            if rate > usual * (GAIN if self._trial > 1.0 else LOSS):
                # As good as hoped, or not as bad as feared: keep it, and go on in that direction.
                self._rates = [rate]
                self._try(FASTER if self._trial > 1.0 else SMALLER)
                return
            self._end_trial(SMALLER if self._trial > 1.0 else LARGER)
            return
        if rate < COLLAPSE * usual:
            self._set(self.limit * rate / usual)
            self._rates = []
        self._rates = [*self._rates, rate][-KEPT_RATES:]
        self._rest -= 1
        if self._rest <= 0:
            self._try(self._next_trial)

    def _end_trial(self, following: float) -> None:
        """Go back to the window before a trial, if there is one; `following` is the factor of the next one."""
        if self._trial:
            self._set(self.limit / self._trial)
            self._next_trial = following
            self._trial = 0.0
            self._rest = REST

    def _try(self, factor: float) -> None:
        before = self.limit
        self._set(max(before * factor, before + FRAGMENT) if factor > 1.0 else before * factor)
        self._trial = self.limit / before if self.limit != before else 0.0
        if not self._trial:
            self._next_trial = SMALLER if factor > 1.0 else LARGER
            self._rest = REST

    def _set(self, limit: float) -> None:
        self.limit = max(float(MIN_WINDOW), min(float(MAX_WINDOW), limit))
