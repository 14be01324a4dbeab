"""The DWM1001's generic mode: type, length, value over a serial line (Decawave API guide; thesis fig. 2.6).

We send a request (type, length, value) and the module answers with a status part `40 01 err`; on err = 0 the
data parts of that call follow. For `dwm_loc_get`, request `0C 00`:

    40 01 00 | 41 0D      x, y, z (i32, mm), quality (u8, %)
             | 49 LEN     a tag: count (u8), then count times:
                          address (u16), distance (u32, mm), quality (u8), position (13 bytes as above)
             | 48 LEN     an anchor: count (u8), then count times: id (u64), distance (u32, mm), quality (u8)

The other calls are in `calls`. All integers are little-endian. There is no checksum and no frame mark, so that a
receiver has to lean on what must hold (types, lengths, counts, percentages); what does not is dropped up to the next
thing that looks like an answer.
"""

import struct
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import field
from typing import Generic, TypeVar

from swarm.errors import FrameError, LocalError
from swarm.frozen import frozen

T_co = TypeVar("T_co", covariant=True)

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

MAX_ANCHOR_RANGES = 19
"""Records of an anchor that fit one part; they are shorter."""

POSITION = 0x41
ANCHOR_RANGES = 0x48
TAG_RANGES = 0x49

_POSITION = struct.Struct("<iiiB")
_RANGE = struct.Struct("<HIB")
_RECORD = _RANGE.size + _POSITION.size
_ANCHOR_RECORD = struct.Struct("<QIB")


class LayoutError(FrameError):
    """An answer is made of other parts than the call's: noise, or another firmware."""


@frozen
class Position:
    """A place as the module knows it."""

    x: float
    """m, in the frame in which the anchors were set up; whole millimetres on the wire."""
    y: float
    z: float
    quality: int
    """0-100; 0 = no fix, and the coordinates are old ones or zero."""


@frozen
class AnchorRange:
    """The distance to one module."""

    anchor: str
    """Short address as printed, high byte first: C933 (travels as 33 C9)."""
    distance: float
    """m, whole millimetres on the wire."""
    quality: int
    """0-100."""
    position: Position
    """The place that the module was told; an anchor's answer does not say it (quality 0)."""


@frozen
class Location:
    """The answer to `dwm_loc_get`: own position and the ranges it was computed from.

    An anchor has ranges only after the phone app's auto-positioning, which has anchors range each other once.
    """

    position: Position
    ranges: tuple[AnchorRange, ...]


@frozen
class Refusal:
    """The module answered with an error instead of data."""

    code: int

    @property
    def name(self) -> str:
        """The error in words."""
        return ERRORS[self.code]


@frozen
class AnswerPart:
    """One data part of an answer: the types it may be of, and the lengths each may have."""

    kinds: Mapping[int, Collection[int]]


@frozen
class ModuleCall(Generic[T_co]):
    """A call of the module's API: what to send, and how its answer is laid out and read."""

    name: str
    request: bytes
    parts: tuple[AnswerPart, ...]
    """The parts of its answer after the status; empty where the answer is the status alone."""
    read: Callable[[list[tuple[int, bytes]]], T_co]
    """Turns the parts' types and values into a result; raises `FrameError` where they cannot be true."""
    heads: tuple[bytes, ...] = field(init=False)
    """How an answer with data may begin."""

    def __post_init__(self) -> None:
        first = self.parts[0].kinds if self.parts else {}
        heads = (bytes((STATUS, 1, OK, kind, length)) for kind in first for length in first[kind])
        object.__setattr__(self, "heads", tuple(heads))


def _percent(value: int, what: str) -> int:
    if value > 100:
        raise FrameError(f"{what} of {value} %")
    return value


def decode_position(value: bytes) -> Position:
    """13 bytes; raises `FrameError` where the quality is no percentage."""
    x, y, z, quality = _POSITION.unpack(value)
    return Position(x / 1000, y / 1000, z / 1000, _percent(quality, "position quality"))


def _location(parts: list[tuple[int, bytes]]) -> Location:
    (_, position), (kind, ranges) = parts
    size = _RECORD if kind == TAG_RANGES else _ANCHOR_RECORD.size
    if len(ranges) != 1 + size * ranges[0]:
        raise FrameError(f"{ranges[0]} ranges announced in a part of {len(ranges)} bytes")
    read = _tag_ranges if kind == TAG_RANGES else _anchor_ranges
    listed = list(read(ranges[1:]))
    return Location(decode_position(position), tuple(listed))


def _tag_ranges(records: bytes) -> Iterable[AnchorRange]:
    for at in range(0, len(records), _RECORD):
        address, distance, quality = _RANGE.unpack_from(records, at)
        place = decode_position(records[at + _RANGE.size : at + _RECORD])
        yield AnchorRange(f"{address:04X}", distance / 1000, _percent(quality, "range quality"), place)


def _anchor_ranges(records: bytes) -> Iterable[AnchorRange]:
    for identity, distance, quality in _ANCHOR_RECORD.iter_unpack(records):
        address = f"{identity & 0xFFFF:04X}"  # the short address is the low end of the 64-bit id
        yield AnchorRange(address, distance / 1000, _percent(quality, "range quality"), NOWHERE)


NOWHERE = Position(0.0, 0.0, 0.0, 0)
"""The place of a module that was not set up, or of which nothing is said."""

POSITION_PART = AnswerPart({POSITION: (_POSITION.size,)})

LOC_GET = ModuleCall(
    "loc_get",
    b"\x0c\x00",
    (
        POSITION_PART,
        AnswerPart(
            {
                TAG_RANGES: range(1, 2 + _RECORD * MAX_RANGES, _RECORD),
                ANCHOR_RANGES: range(1, 2 + _ANCHOR_RECORD.size * MAX_ANCHOR_RANGES, _ANCHOR_RECORD.size),
            }
        ),
    ),
    _location,
)
"""Own position and the distances to all anchors in sight of a tag."""


class TlvDecoder(Generic[T_co]):
    """Takes the module's bytes apart as answers to one call, in pieces of any size, among any noise.

    A wrong frame costs itself and nothing after it: reading goes on at the next byte that can start an
    answer. An answer that was cut off is noticed when the head of the next one appears inside it.
    """

    def __init__(self, call: ModuleCall[T_co]) -> None:
        self.skipped = 0
        """Bytes thrown away so far because no answer can start there."""
        self._call = call
        self._buffer = bytearray()
        self.raw = b""
        """The bytes of the last answer that `next` gave."""

    def receive(self, data: bytes) -> None:
        """Take bytes as they came from the line; then call `next` until it gives None."""
        self._buffer += data

    def reset(self) -> None:
        """Forget a half-received answer: its rest is not going to come."""
        self.skipped += len(self._buffer)
        self._buffer.clear()

    def next(self) -> T_co | Refusal | None:
        """Return the next answer, None where more bytes are needed.

        Raises `FrameError` for what started like an answer and is none; it has been dropped, call again.
        """
        buffer = self._buffer
        while self._seek():
            if buffer[2] != OK:
                refusal = Refusal(buffer[2])
                self._take(3)
                return refusal
            try:
                values, end = self._data()
                if values is None:
                    return None
                result = self._call.read(values)
            except FrameError:
                self._skip(1)
                raise
            self._take(end)
            return result
        return None

    def _take(self, count: int) -> None:
        self.raw = bytes(self._buffer[:count])
        del self._buffer[:count]

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

    def _data(self) -> tuple[list[tuple[int, bytes]] | None, int]:
        """Types and values of the data parts, and where they end; no values where bytes are missing."""
        name, buffer, at = self._call.name, self._buffer, 3
        values: list[tuple[int, bytes]] = []
        for part in self._call.parts:
            if len(buffer) > at and buffer[at] not in part.kinds:
                expected = " or ".join(f"{kind:02X}" for kind in part.kinds)
                raise LayoutError(f"{name}: part of type {buffer[at]:02X}, expected {expected}")
            if len(buffer) > at + 1 and buffer[at + 1] not in part.kinds[buffer[at]]:
                raise LayoutError(f"{name}: part {buffer[at]:02X} of {buffer[at + 1]} bytes")
            end = at + 2 + buffer[at + 1] if len(buffer) > at + 1 else len(buffer) + 1
            if end > len(buffer):
                at = len(buffer)
                break
            values.append((buffer[at], bytes(buffer[at + 2 : end])))
            at = end
        # A head may begin inside and end behind: then it swallowed the last bytes.
        if any(buffer.find(head, 1, at + len(head) - 1) > 0 for head in self._call.heads):
            raise FrameError(f"{name}: cut off by the head of another answer")
        return (values if len(values) == len(self._call.parts) else None), at

    def _skip(self, count: int) -> None:
        del self._buffer[:count]
        self.skipped += count


def encode_refusal(code: int) -> bytes:
    """Return the answer of a module that refuses a call; 0 is the answer to a call that asks for no data."""
    return bytes((STATUS, 1, code))


def encode_part(kind: int, value: bytes) -> bytes:
    """Pack type, length and value."""
    return bytes((kind, len(value))) + value


def encode_location(location: Location, *, anchor: bool = False) -> bytes:
    """Return the answer of a tag, or of an anchor, to `dwm_loc_get`. Raises `LocalError` where a value does not fit."""
    most = MAX_ANCHOR_RANGES if anchor else MAX_RANGES
    if len(location.ranges) > most:
        raise LocalError(f"{len(location.ranges)} ranges, an answer holds at most {most}")
    try:
        records = b"".join(map(_anchor_record if anchor else _tag_record, location.ranges))
    except (struct.error, ValueError) as error:
        raise LocalError(f"a location that no module can report: {error}") from None
    ranges = bytes((len(location.ranges),)) + records
    return (
        encode_refusal(OK)
        + encode_part(POSITION, encode_position(location.position))
        + encode_part(ANCHOR_RANGES if anchor else TAG_RANGES, ranges)
    )


def encode_position(place: Position) -> bytes:
    """13 bytes; raises `LocalError` where a value does not fit its field."""
    try:
        return _POSITION.pack(round(place.x * 1000), round(place.y * 1000), round(place.z * 1000), place.quality)
    except (struct.error, ValueError, OverflowError) as error:  # the others of nan and inf
        raise LocalError(f"a position that no module can hold: {error}") from None


def _tag_record(item: AnchorRange) -> bytes:
    head = _RANGE.pack(int(item.anchor, 16), round(item.distance * 1000), item.quality)
    return head + encode_position(item.position)


def _anchor_record(item: AnchorRange) -> bytes:
    return _ANCHOR_RECORD.pack(int(item.anchor, 16), round(item.distance * 1000), item.quality)
