"""The DWM1001's generic mode: type, length, value over a serial line (Decawave API guide; thesis fig. 2.6).

We send a request (type, length, value) and the module answers with a status part `40 01 err`; on err = 0 the
data parts of that call follow. For `dwm_loc_get`, request `0C 00`:

    40 01 00 | 41 0D      x, y, z (i32, mm), quality (u8, %)
             | 49 LEN     count (u8), then count times:
                          address (u16), distance (u32, mm), quality (u8), position (13 bytes as above)

All integers are little-endian. There is no checksum and no frame mark, so that a receiver has to lean on what
must hold (types, lengths, counts, percentages); what does not is dropped up to the next thing that looks like
an answer.
"""

import struct
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

from swarm.errors import FrameError, LocalError

T = TypeVar("T")

STATUS = 0x40
OK = 0

ERRORS = {
    1: "unknown call or broken frame",
    2: "internal error",
    3: "bad parameter",
    4: "busy",
    5: "not permitted",
}
"""What the module says in the status part where it does not say OK."""

MAX_RANGES = 12
"""Records that fit one part: its length is one byte and at most 253 (API guide: values of 0 to 253 bytes)."""

_POSITION = struct.Struct("<iiiB")
_RANGE = struct.Struct("<HIB")
_RECORD = _RANGE.size + _POSITION.size


@dataclass(frozen=True, slots=True)
class Position:
    """A place as the module knows it."""

    x: float
    """m, in the frame in which the anchors were set up; whole millimetres on the wire."""
    y: float
    z: float
    quality: int
    """0-100; 0 = no fix, and the coordinates are old ones or zero."""


@dataclass(frozen=True, slots=True)
class AnchorRange:
    """The distance to one module."""

    anchor: str
    """Short address as printed, high byte first: C933 (travels as 33 C9)."""
    distance: float
    """m, whole millimetres on the wire."""
    quality: int
    """0-100."""
    position: Position
    """Where that module was set up to be."""


@dataclass(frozen=True, slots=True)
class Location:
    """The answer of a tag to `dwm_loc_get`: own position and the ranges it was computed from."""

    position: Position
    ranges: tuple[AnchorRange, ...]


@dataclass(frozen=True, slots=True)
class Refusal:
    """The module answered with an error instead of data."""

    code: int

    @property
    def name(self) -> str:
        """The error in words."""
        return ERRORS[self.code]


@dataclass(frozen=True, slots=True)
class Part:
    """One data part of an answer: its type and the lengths it may have."""

    kind: int
    lengths: Collection[int]


@dataclass(frozen=True, slots=True)
class Call(Generic[T]):
    """A call of the module's API: what to send, and how its answer is laid out and read."""

    name: str
    request: bytes
    parts: tuple[Part, ...]
    read: Callable[[list[bytes]], T]
    """Turns the parts' values into a result; raises `FrameError` where they cannot be true."""


def _percent(value: int, what: str) -> int:
    if value > 100:
        raise FrameError(f"{what} of {value} %")
    return value


def _position(value: bytes) -> Position:
    x, y, z, quality = _POSITION.unpack(value)
    return Position(x / 1000, y / 1000, z / 1000, _percent(quality, "position quality"))


def _location(values: list[bytes]) -> Location:
    position, ranges = values
    if len(ranges) != 1 + _RECORD * ranges[0]:
        raise FrameError(f"{ranges[0]} ranges announced in a part of {len(ranges)} bytes")
    return Location(_position(position), tuple(_ranges(ranges[1:])))


def _ranges(records: bytes) -> Iterable[AnchorRange]:
    for at in range(0, len(records), _RECORD):
        address, distance, quality = _RANGE.unpack_from(records, at)
        place = _position(records[at + _RANGE.size : at + _RECORD])
        yield AnchorRange(f"{address:04X}", distance / 1000, _percent(quality, "range quality"), place)


LOC_GET = Call(
    "loc_get",
    b"\x0c\x00",
    (Part(0x41, (_POSITION.size,)), Part(0x49, range(1, 2 + _RECORD * MAX_RANGES, _RECORD))),
    _location,
)
"""Own position and the distances to all anchors in sight, of a tag."""


class Decoder(Generic[T]):
    """Takes the module's bytes apart as answers to one call, in pieces of any size, among any noise.

    A wrong frame costs itself and nothing after it: reading goes on at the next byte that can start an
    answer. An answer that was cut off is noticed when the head of the next one appears inside it.
    """

    def __init__(self, call: Call[T]) -> None:
        self.skipped = 0
        """Bytes thrown away so far because no answer can start there."""
        self._call = call
        self._buffer = bytearray()
        first = call.parts[0]
        self._heads = [bytes((STATUS, 1, OK, first.kind, length)) for length in first.lengths]

    def receive(self, data: bytes) -> None:
        """Take bytes as they came from the line; then call `next` until it gives None."""
        self._buffer += data

    def reset(self) -> None:
        """Forget a half-received answer: its rest is not going to come."""
        self.skipped += len(self._buffer)
        self._buffer.clear()

    def next(self) -> T | Refusal | None:
        """The next answer, None where more bytes are needed.

        Raises `FrameError` for what started like an answer and is none; it has been dropped, call again.
        """
        buffer = self._buffer
        while self._seek():
            if buffer[2] != OK:
                refusal = Refusal(buffer[2])
                del buffer[:3]
                return refusal
            try:
                values, end = self._data()
                if values is None:
                    return None
                result = self._call.read(values)
            except FrameError:
                self._skip(1)
                raise
            del buffer[:end]
            return result
        return None

    def _seek(self) -> bool:
        """Move to the next status part; False where there is no whole one yet."""
        buffer = self._buffer
        while buffer:
            start = buffer.find(STATUS)
            self._skip(len(buffer) if start < 0 else start)
            if (len(buffer) > 1 and buffer[1] != 1) or (len(buffer) > 2 and buffer[2] not in (OK, *ERRORS)):
                self._skip(1)
            else:
                return len(buffer) >= 3
        return False

    def _data(self) -> tuple[list[bytes] | None, int]:
        """The values of the data parts and where they end; no values where bytes are missing."""
        name, buffer, at = self._call.name, self._buffer, 3
        values: list[bytes] | None = []
        for part in self._call.parts:
            if len(buffer) > at and buffer[at] != part.kind:
                raise FrameError(f"{name}: part of type {buffer[at]:02X}, expected {part.kind:02X}")
            if len(buffer) > at + 1 and buffer[at + 1] not in part.lengths:
                raise FrameError(f"{name}: part {part.kind:02X} of {buffer[at + 1]} bytes")
            end = at + 2 + buffer[at + 1] if len(buffer) > at + 1 else len(buffer) + 1
            if end > len(buffer):
                values, at = None, len(buffer)
                break
            assert values is not None
            values.append(bytes(buffer[at + 2 : end]))
            at = end
        # A head may begin inside and end behind: then it swallowed the last bytes.
        if any(buffer.find(head, 1, at + len(head) - 1) > 0 for head in self._heads):
            raise FrameError(f"{name}: cut off by the head of another answer")
        return values, at

    def _skip(self, count: int) -> None:
        del self._buffer[:count]
        self.skipped += count


def encode_refusal(code: int) -> bytes:
    """The answer of a module that refuses a call."""
    return bytes((STATUS, 1, code))


def encode_location(location: Location) -> bytes:
    """The answer of a tag to `dwm_loc_get`. Raises `LocalError` where a value does not fit its field."""
    if len(location.ranges) > MAX_RANGES:
        raise LocalError(f"{len(location.ranges)} ranges, an answer holds at most {MAX_RANGES}")
    try:
        records = b"".join(
            _RANGE.pack(int(item.anchor, 16), round(item.distance * 1000), item.quality) + _pack(item.position)
            for item in location.ranges
        )
        place = _pack(location.position)
    except (struct.error, ValueError) as error:
        raise LocalError(f"a location that no module can report: {error}") from None
    head = bytes((STATUS, 1, OK, 0x41, len(place)))
    return head + place + bytes((0x49, 1 + len(records), len(location.ranges))) + records


def _pack(place: Position) -> bytes:
    return _POSITION.pack(round(place.x * 1000), round(place.y * 1000), round(place.z * 1000), place.quality)
