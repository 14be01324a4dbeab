"""Packets by which one robot fetches a large message from another, byte by byte (docs/overlays.md).

    OFFER   here is a message for you, so large, under this key       WANT   give me these pieces of it
    PIECE   one of them                                               STATE  delivered, refused, or: ask later
    GONE    I do not have it (any more)

They travel as unicast does, hop by hop; a robot on the way reads no more than the head. Little endian. Every decoder
raises `FrameError` for bytes that are none of its packets, and nothing else.
"""

import struct
from collections.abc import Iterable
from typing import NamedTuple

from services.mesh.core.wire import packets
from services.mesh.core.wire.fragments import MAX_MESSAGE
from services.mesh.core.wire.texts import Reader, packed
from swarm.errors import FrameError

OFFER, WANT, PIECE, STATE, GONE = 3, 4, 5, 6, 7
"""Kinds of packets on unicast channels, besides `packets.MESSAGE` and `packets.ACK`."""

DONE, REFUSED, LATER = 0, 1, 2
"""What a STATE says."""

SIZE = 1880
"""Bytes of a message in one piece, the last one aside: with all headers two fragments of a quiet link."""

MAX_RANGES = 32
MAX_WANTED = 128
"""Pieces of one WANT, and runs of neighbouring ones that they are told by."""

LEAST_MESSAGE = packets.MAX_MESSAGE + 1
"""Bytes of the smallest message that is offered. Bookkeeping costs a receiver about 1 kB a message, and the room for
messages is counted in bytes: without this bound a peer could offer millions of messages of one byte."""

_HEAD = struct.Struct("<BBBQI")
_OFFER = struct.Struct("<I")
_WANT = struct.Struct("<HB")
_RANGE = struct.Struct("<HH")
_PIECE = struct.Struct("<H")
_OF_FLOOD = 1


class Id(NamedTuple):
    """Names one large message in the whole swarm."""

    origin: str
    incarnation: int
    number: int
    """A flood's sequence; else it counts what the origin offered to one robot, from 1."""
    flood: bool


class Packet(NamedTuple):
    """What all kinds share."""

    kind: int
    sender: str
    to: str
    id: Id
    body: bytes
    ttl: int = 0


class Want(NamedTuple):
    """Body of a WANT."""

    have: int
    """Pieces that are there already."""
    indexes: tuple[int, ...]


def count_of(total: int) -> int:
    """Pieces of a message of so many bytes."""
    return -(-total // SIZE)


def encode(packet: Packet) -> bytes:
    """Any packet."""
    id = packet.id
    head = _HEAD.pack(packet.kind, packet.ttl, _OF_FLOOD if id.flood else 0, id.incarnation, id.number)
    origin = packed(id.origin) if id.flood else b""
    return head + packed(packet.sender) + packed(packet.to) + origin + packet.body


def decode(data: bytes) -> Packet:
    """Any packet. Where it is no flood's the origin is who offers."""
    if len(data) < _HEAD.size:
        raise FrameError(f"packet of {len(data)} bytes about a large message: it has at least {_HEAD.size}")
    kind, ttl, flags, incarnation, number = _HEAD.unpack_from(data)
    # A flood is announced by a SPREAD. An OFFER of one would pass by the bounds of both overlays.
    wrong_flags = flags > _OF_FLOOD or (flags and kind in (OFFER, STATE))
    if not OFFER <= kind <= GONE or wrong_flags or not number:
        raise FrameError(f"packet kind {kind}, flags {flags:#x}, number {number} about a large message: not known")
    reader = Reader(data, _HEAD.size)
    sender, to = reader.name(), reader.name()
    offers = to if kind in (WANT, STATE) else sender
    origin = reader.name() if flags else offers
    return Packet(kind, sender, to, Id(origin, incarnation, number, bool(flags)), data[reader.at :], ttl)


def passed_on(data: bytes) -> bytes:
    """A packet as it leaves a robot on its way."""
    return data[:1] + bytes((data[1] - 1,)) + data[2:]


def encode_offer(total: int, key: str) -> bytes:
    """Body of an OFFER."""
    return _OFFER.pack(total) + packed(key, 255)


def decode_offer(body: bytes) -> tuple[int, str]:
    """Bytes and key of the message that is offered."""
    reader = Reader(body, 0)
    (total,) = reader.unpack(_OFFER)
    key = reader.key()
    reader.end()
    check_total(total)
    return total, key


def check_total(total: int) -> None:
    """Raises `FrameError` where no large message has so many bytes."""
    if not LEAST_MESSAGE <= total <= MAX_MESSAGE:
        raise FrameError(f"an offer of {total} bytes: {LEAST_MESSAGE} to {MAX_MESSAGE} are allowed")


def encode_want(have: int, indexes: Iterable[int]) -> bytes:
    """Body of a WANT. Indexes go up within each run of neighbouring ones; at most `MAX_WANTED`."""
    runs: list[list[int]] = []
    for index in indexes:
        if runs and index == runs[-1][0] + runs[-1][1]:
            runs[-1][1] += 1
        elif len(runs) < MAX_RANGES:
            runs.append([index, 1])
        else:
            break
    return _WANT.pack(have, len(runs)) + b"".join(_RANGE.pack(first, count) for first, count in runs)


def decode_want(body: bytes) -> Want:
    """What a WANT asks for."""
    reader = Reader(body, 0)
    have, count = reader.unpack(_WANT)
    if count > MAX_RANGES:
        raise FrameError(f"WANT of {count} runs: at most {MAX_RANGES} are allowed")
    indexes: list[int] = []
    for _ in range(count):
        first, length = reader.unpack(_RANGE)
        if len(indexes) + length > MAX_WANTED:
            raise FrameError(f"WANT of more than {MAX_WANTED} pieces")
        indexes += range(first, first + length)
    reader.end()
    return Want(have, tuple(indexes))


def encode_piece(index: int, data: bytes) -> bytes:
    """Body of a PIECE."""
    return _PIECE.pack(index) + data


def decode_piece(body: bytes) -> tuple[int, bytes]:
    """Index and bytes of a piece."""
    if not _PIECE.size < len(body) <= _PIECE.size + SIZE:
        raise FrameError(f"PIECE of {len(body) - _PIECE.size} bytes: 1 to {SIZE} are allowed")
    return _PIECE.unpack_from(body)[0], body[_PIECE.size :]


def encode_state(state: int) -> bytes:
    """Body of a STATE."""
    return bytes((state,))


def decode_state(body: bytes) -> int:
    """`DONE`, `REFUSED` or `LATER`."""
    if len(body) != 1 or body[0] > LATER:
        raise FrameError(f"STATE {body[:8]!r}: 0 to {LATER} are known")
    return body[0]
