"""Messages larger than a frame: cut into FRAGMENT frames, put together again at the other end.

The fragments of one channel come in order and one message at a time; those of different channels are interleaved. A
link loses nothing while it lives, so a gap is a defect of the sender and ends the connection; what is incomplete when
the link ends is gone. The receiver holds a bounded number of bytes for each peer, whatever the peer announces.
"""

import struct
from collections import Counter
from typing import NamedTuple

from services.mesh.core.wire import frames
from swarm.errors import FrameError

MAX_MESSAGE = 1024 * 1024
"""Largest message, in bytes; files go by other ways."""

LARGE = 976
"""Bytes of a message in one fragment: with all headers less than 1000, which Bluetooth's packets of 1021 hold."""

SMALL = 256
"""The same while synchronous apps talk on the link: 3.3 ms at Bluetooth's 78 kB/s, nothing waits longer for it."""

MAX_INCOMPLETE = 64
"""Messages of one peer that may be incomplete at the same time."""

MAX_BYTES = 3 * 1024 * 1024 // 2
"""Announced bytes of the incomplete messages of one peer."""

TIMEOUT = 30.0
"""s without a fragment after which an incomplete message is dropped."""

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
    """A FRAGMENT frame."""
    marked = fragment.number | (_LAST if fragment.last else 0)
    if fragment.number == 0:
        head = _FIRST.pack(fragment.channel, marked, fragment.total)
    else:
        head = _HEAD.pack(fragment.channel, marked)
    return frames.encode(frames.FRAGMENT, frames.BULK, head + fragment.data)


def decode_fragment(body: bytes) -> Fragment:
    """The body of a FRAGMENT frame. Raises `FrameError`."""
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
        if not 1 <= total <= MAX_MESSAGE:
            raise FrameError(f"FRAGMENT of a message of {total} bytes: 1 to {MAX_MESSAGE} are allowed")
    if len(body) == size:
        raise FrameError("FRAGMENT without a byte of the message")
    return Fragment(channel, number, last, total, body[size:])


class _Incomplete:
    """What has come of one message."""

    __slots__ = ("data", "heard", "next", "total")

    def __init__(self, total: int) -> None:
        self.total = total
        self.data = bytearray()
        """What has come. Not a list of fragments: each of a few bytes would cost fifty."""
        self.next = 0
        self.heard = 0.0


class Reassembly:
    """The incomplete messages of one peer, on one connection."""

    __slots__ = (
        "_bytes",
        "_counters",
        "_messages",
    )

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
            if len(self._messages) >= MAX_INCOMPLETE or self._bytes + fragment.total > MAX_BYTES:
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
        for channel in [channel for channel, each in self._messages.items() if now >= each.heard + TIMEOUT]:
            self.drop(channel)
