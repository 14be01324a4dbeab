"""Bytes of the lockstep protocol: channel, frames and snapshot (docs/reference/network/lockstep.md has the layouts).

A frame on the air is as short as it can be: run, epoch, incarnation and schema are in the channel, which is
one chunk of the bus key and which the mesh binds once to a handle. All integers are little endian.
"""

import re
import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple, Self

from swarm.errors import FrameError, LocalError
from swarm.frozen import frozen

MAX_ITERATION = 2**32 - 1
"""Highest iteration a frame can carry: 4.5 years at 30 iterations a second."""

STEP = 1
WANT = 2

_HEAD = struct.Struct("<BI")
_CHANNEL = re.compile(r"([0-9a-f]{16})-(0|[1-9][0-9]{0,9})-(0|[1-9][0-9]{0,19})-([0-9a-f]{8})")


@frozen
class Channel:
    """The identity of a sender's frames: their run, epoch, process and version of the app."""

    run: int
    """u64, given by the launcher, the same on all robots, bound to a hash of app and config."""
    epoch: int
    """u32, the epoch of the run: its members and links."""
    incarnation: int
    """u64, goes up with every start of the process: the fencing token of R6."""
    schema: int
    """u32, hash of the state's declared fields and types."""

    def __post_init__(self) -> None:
        for name, bits in (("run", 64), ("epoch", 32), ("incarnation", 64), ("schema", 32)):
            if not 0 <= getattr(self, name) < 2**bits:
                raise LocalError(f"channel: {name} {getattr(self, name)} does not fit in {bits} bits")

    @property
    def text(self) -> str:
        """The channel as one chunk of a key, e.g. `00000000000000a1-0-3-9f3c21aa`."""
        return f"{self.run:016x}-{self.epoch}-{self.incarnation}-{self.schema:08x}"

    @classmethod
    def parse(cls, text: str) -> "Channel":
        """Read the chunk back; `FrameError` where it is not exactly what `text` would give."""
        return _parse_channel(text)


@lru_cache(maxsize=64)
def _parse_channel(text: str) -> Channel:
    # Cached: every frame comes with its channel, and a run has one for each neighbour.
    match = _CHANNEL.fullmatch(text)
    if match is None:
        raise FrameError(f"channel {text[:60]!r}: expected <run>-<epoch>-<incarnation>-<schema>")
    run, epoch, incarnation, schema = match.groups()
    try:
        return Channel(int(run, 16), int(epoch), int(incarnation), int(schema, 16))
    except LocalError as error:
        raise FrameError(str(error)) from None


class Step(NamedTuple):
    """`x(k)` of the sender and, beside it, `x(k-1)`: any lone frame repairs a gap (R2)."""

    k: int
    value: bytes
    previous: bytes | None


class Want(NamedTuple):
    """The sender is at iteration `k` and lacks the receiver's `x(k)`."""

    k: int


def encode_step(k: int, value: bytes, previous: bytes | None) -> bytes:
    """Pack a `Step`; `previous` is None exactly for k = 0."""
    return _HEAD.pack(STEP, k) + value + (previous or b"")


def encode_want(k: int) -> bytes:
    return _HEAD.pack(WANT, k)


def decode_frame(data: bytes, size: int) -> Step | Want:
    """Unpack a frame whose states are of `size` bytes; `FrameError` says what is wrong with it."""
    if len(data) < _HEAD.size:
        raise FrameError(f"lockstep frame of {len(data)} bytes, at least {_HEAD.size} are needed")
    kind, k = _HEAD.unpack_from(data)
    if kind == STEP and k and len(data) == _HEAD.size + 2 * size:  # nearly all are such
        middle = _HEAD.size + size
        return Step(k, bytes(data[_HEAD.size : middle]), bytes(data[middle:]))
    body = bytes(data[_HEAD.size :])
    if kind == WANT:
        if body:
            raise FrameError(f"lockstep WANT with {len(body)} bytes too many")
        return Want(k)
    if kind != STEP:
        raise FrameError(f"lockstep frame of unknown kind {kind}")
    wanted = size if k == 0 else 2 * size
    if len(body) != wanted:
        raise FrameError(f"lockstep STEP {k} with {len(body)} bytes of states, expected {wanted}")
    return Step(k, body[:size], body[size:] if k else None)


@dataclass(slots=True)
class HeardNeighbour:
    """What this robot has heard of one neighbour."""

    incarnation: int = -1
    """Highest incarnation seen, -1 for none yet."""
    reached: int = -1
    """Highest iteration it is known to be at."""
    slots: list[bytes | None] = field(default_factory=lambda: [None, None, None])
    """The neighbour's values, that of iteration k in place k % 3: k and k+1 to be used, k-1 (used already) to be
    compared."""

    def contradicted(self, frame: Step, k: int) -> int | None:
        """Return the iteration for which a frame has another value than was heard. `k` is the own iteration."""
        for at, value in ((frame.k - 1, frame.previous), (frame.k, frame.value)):
            if value is not None and k - 1 <= at <= k + 1 and self.slots[at % 3] not in (None, value):
                return at
        return None


_SNAPSHOT = struct.Struct("<4sQIIIIBI")
_PEER = struct.Struct("<QBIBB")
_MAGIC = b"BLS1"
_CHECK = struct.Struct("<I")


@frozen
class Snapshot:
    """What a restarted process needs to go on without a fork of the trajectory (R5)."""

    run: int
    epoch: int
    schema: int
    size: int
    k: int
    value: bytes
    previous: bytes | None
    heard: dict[str, HeardNeighbour]
    private: bytes

    def encode(self) -> bytes:
        """Pack, with a checksum at the end."""
        parts = [
            _SNAPSHOT.pack(
                *(_MAGIC, self.run, self.epoch, self.schema, self.size, self.k),
                *(len(self.heard), len(self.private)),
            ),
            self.value,
            self.previous or b"",
        ]
        places = (self.k - 1) % 3, self.k % 3, (self.k + 1) % 3
        for name in sorted(self.heard):
            peer, chars, values, mask = self.heard[name], name.encode(), [], 0
            for bit, place in enumerate(places):  # of each iteration, so without generators
                if (value := peer.slots[place]) is not None:
                    values.append(value)
                    mask |= 1 << bit
            known = peer.incarnation >= 0
            head = _PEER.pack(peer.incarnation if known else 0, known, max(peer.reached, 0), mask, len(chars))
            parts += (head, chars, *values)
        parts.append(self.private)
        data = b"".join(parts)
        return data + _CHECK.pack(zlib.crc32(data))

    def check(self, channel: Channel, size: int, neighbours: Iterable[str]) -> None:
        """Raise `LocalError` unless the snapshot is of this run, epoch, app and topology; `size`: bytes of a state."""
        for what, found, expected in (
            ("run", f"{self.run:016x}", f"{channel.run:016x}"),
            ("epoch", self.epoch, channel.epoch),
            ("schema", f"{self.schema:08x}", f"{channel.schema:08x}"),
            ("state size", self.size, size),
            ("neighbours", " ".join(self.heard), " ".join(neighbours)),
        ):
            if found != expected:
                raise LocalError(f"snapshot: {what} {found}, this is {what} {expected}")

    @classmethod
    def decode(cls, data: bytes) -> Self:
        """Unpack; `LocalError` where the data is not a whole snapshot."""
        if not data.startswith(_MAGIC):
            raise LocalError("snapshot: not one of this version of the lockstep")
        body = data[: -_CHECK.size]
        if len(body) < _SNAPSHOT.size or _CHECK.pack(zlib.crc32(body)) != data[-_CHECK.size :]:
            raise LocalError(f"snapshot: truncated or damaged ({len(data)} bytes, the checksum does not match)")
        # The checksum has matched, so the lengths within are those that a version of encode() wrote.
        _, run, epoch, schema, size, k, peers, private = _SNAPSHOT.unpack_from(body)
        rest = _Reader(body, _SNAPSHOT.size)
        value = rest.take(size)
        previous = rest.take(size) if k else None
        heard = {}
        for _ in range(peers):
            incarnation, known, reached, mask, length = _PEER.unpack(rest.take(_PEER.size))
            name = rest.take(length).decode(errors="replace")
            slots: list[bytes | None] = [None, None, None]
            for bit in range(3):
                if mask >> bit & 1:
                    slots[(k + bit - 1) % 3] = rest.take(size)
            heard[name] = HeardNeighbour(incarnation, reached, slots) if known else HeardNeighbour()
        return cls(run, epoch, schema, size, k, value, previous, heard, rest.take(private))


class _Reader:
    """Takes a run of bytes apart from front to back."""

    def __init__(self, data: bytes, at: int) -> None:
        self._data = data
        self._at = at

    def take(self, count: int) -> bytes:
        if count > len(self._data) - self._at:
            raise LocalError(f"snapshot: its lengths contradict one another ({len(self._data)} bytes)")
        piece = self._data[self._at : self._at + count]
        self._at += count
        return piece
