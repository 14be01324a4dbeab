"""What the overlays say in DATA frames of their channels, byte by byte (docs/overlays.md).

All numbers are little endian; names stand behind their length (u8). Every decoder raises `FrameError` for bytes
that are none of its packets, and nothing else.
"""

import struct
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import NamedTuple

from services.mesh.core.wire.fragments import MAX_MESSAGE as MAX_LARGE
from services.mesh.core.wire.frames import MAX_PAYLOAD
from services.mesh.core.wire.texts import Reader, packed
from swarm.errors import FrameError

SPREAD, ECHO, DIGEST, SUMMARY, HALT, TOPOLOGY = 1, 2, 3, 4, 5, 6
"""Kinds of packets on flood channels; the last one is made in `topology`."""

MESSAGE, ACK = 1, 2
"""Kinds of packets on unicast channels."""

MAX_INCARNATION = (1 << 64) - 1
MAX_SEQUENCE = (1 << 32) - 1

_SPREAD = struct.Struct("<BBQI")
_FIRST = struct.Struct("<I")
_SIZE = struct.Struct("<I")
_ECHO = struct.Struct("<BBBQIH")
_DIGEST = struct.Struct("<BBH")
_DIGEST_ENTRY = struct.Struct("<QI")
_SUMMARY = struct.Struct("<BBI")
_HALT = struct.Struct("<BBB")
_MARK = struct.Struct("<QI")
_LSA = struct.Struct("<BB")
_COUNT = struct.Struct("<B")
_METRIC = struct.Struct("<H")
_MESSAGE = struct.Struct("<BBQI")
_ACK = struct.Struct("<BBBQI")

MAX_SPREAD = MAX_PAYLOAD - _SPREAD.size - _FIRST.size
"""Longest payload of a flood in one packet, in bytes."""

MAX_MESSAGE = MAX_PAYLOAD - _MESSAGE.size - 2 * 17 - 256
"""Longest payload of a unicast message in one packet, in bytes, whatever its names and key."""

MAX_DIGEST = 1024
"""Bytes of one DIGEST packet: it must not hold up what is urgent."""

MAX_REASON = 64
"""Bytes of a stop's reason."""

MAX_TWINS = 16
"""Names that one LSA tells of as those of two robots."""

_HALT_ENTRIES = 20
"""Robots in one HALT packet: at most 1.9 kB."""


class Spread(NamedTuple):
    """A flooded message. Its origin is the robot that its channel's key belongs to."""

    incarnation: int
    """Of the origin: goes up with each of its starts."""
    sequence: int
    """Counts the origin's floods from 1."""
    payload: bytes
    echo: bool = False
    """The origin wants to know whom it reached."""
    latest: bool = False
    """The newest value of this key is kept for those who come later."""
    first: int = 0
    """The sequence of the first try where this is a second one: who saw that one must not deliver it again."""
    size: int = 0
    """Bytes of the message where this only announces it (`core.largefloods`); the payload is empty then."""


class Echo(NamedTuple):
    """The answer to a flood, on its way back to the origin."""

    incarnation: int
    sequence: int
    robots: tuple[str, ...]
    """Who was reached behind the sender, the sender included."""
    lost: bool = False
    """A link broke before its echo came: there may be more."""
    orphan: bool = False
    """It does not come from the far end of its edge but from one that lost its way back."""
    ttl: int = 0
    """Further hops an orphan may take."""


class Digest(NamedTuple):
    """What a neighbour holds of the origins whose names are above `low` and up to `high`."""

    low: str
    high: str
    """Empty = no bound."""
    origins: dict[str, tuple[int, int]]
    """Incarnation and checksum of the latest values, by origin."""
    answer: bool
    """The sender wants ours in return."""


class Mark(NamedTuple):
    """A stop of one robot. Later ones are greater."""

    incarnation: int
    number: int


class Halt(NamedTuple):
    """All that a robot knows of stops and of what re-armed the swarm."""

    stops: dict[str, tuple[Mark, str]]
    """The newest stop of each robot, and its reason."""
    arms: dict[str, Mark]
    """The newest stop of each robot that was taken back."""


class Advertisement(NamedTuple):
    """What a robot says of its own links (LSA)."""

    neighbours: dict[str, int]
    """One-way time to each, in units of 0.1 ms."""
    leaving: bool = False
    topology: int = 0
    """Which topology holds there (its tag, u32); 0 = the configuration's own."""
    heard: int = 0
    """The robots it has reached by calling them, with the automatic topology: bit i = robot i of the configuration."""
    process: int = 0
    """Number of the mesh process that tells this, u32: the low half of the incarnation in its HELLO. 0: not told."""
    twins: tuple[str, ...] = ()
    """Names that two robots have, as far as this robot has seen it itself; at most `MAX_TWINS`, sorted."""


class Message(NamedTuple):
    """A unicast message on its way."""

    sender: str
    to: str
    incarnation: int
    """Of the sender."""
    number: int
    """Counts what this sender sent to this receiver, from 1. Message 0 is sent once, nobody acknowledges it, and it
    does not use the link between its sender and its receiver."""
    key: str
    payload: bytes
    ttl: int

    @property
    def avoided(self) -> tuple[str, str] | None:
        """The ends of the link that the message must not use; None where it may use any."""
        return None if self.number else (self.sender, self.to)


class Ack(NamedTuple):
    """The receiver's answer on its way back."""

    sender: str
    """Who answers."""
    to: str
    """Whose message it was."""
    incarnation: int
    number: int
    refused: bool
    ttl: int


# -- flood channels --------------------------------------------------------------------------------------------


def kind_of(data: bytes) -> int:
    """The kind of a packet."""
    if not data:
        raise FrameError("overlay packet without a kind")
    return data[0]


def encode_spread(packet: Spread) -> bytes:
    """A SPREAD packet: 14 bytes before the payload, 18 on the second try."""
    flags = packet.echo | packet.latest << 1 | bool(packet.first) << 2 | bool(packet.size) << 3
    head = _SPREAD.pack(SPREAD, flags, packet.incarnation, packet.sequence)
    head += _FIRST.pack(packet.first) if packet.first else b""
    return head + (_SIZE.pack(packet.size) if packet.size else packet.payload)


def decode_spread(data: bytes) -> Spread:
    """A SPREAD packet. It comes once from each neighbour: a small one is taken apart only the first time."""
    return _decode_small_spread(data) if len(data) <= _SMALL else _decode_spread(data)


def _decode_spread(data: bytes) -> Spread:
    if len(data) < _SPREAD.size:
        raise FrameError(f"SPREAD of {len(data)} bytes: it has at least {_SPREAD.size}")
    _, flags, incarnation, sequence = _SPREAD.unpack_from(data)
    if flags > 15 or flags & 3 == 3 or not sequence:
        raise FrameError(f"SPREAD flags {flags:#x}, sequence {sequence}: not known")
    at, first = _SPREAD.size, 0
    if flags & 4:
        if len(data) < at + _FIRST.size:
            raise FrameError("SPREAD without the number of its first try")
        (first,) = _FIRST.unpack_from(data, at)
        at += _FIRST.size
        if not 0 < first < sequence:
            raise FrameError(f"SPREAD {sequence} claims to repeat {first}")
    payload, size = data[at:], 0
    if flags & 8:
        if len(payload) != _SIZE.size:
            raise FrameError(f"SPREAD announces a message by {len(payload)} bytes: it takes {_SIZE.size}")
        payload, (size,) = b"", _SIZE.unpack(payload)
        if not MAX_SPREAD < size <= MAX_LARGE:
            raise FrameError(f"SPREAD announces {size} bytes: {MAX_SPREAD + 1} to {MAX_LARGE} are allowed")
    return Spread(incarnation, sequence, payload, bool(flags & 1), bool(flags & 2), first, size)


_SMALL = 256
"""Bytes of a packet whose decoded form is remembered: 256 SPREADs take 130 kB, 1024 LSAs 2 MB, whatever peers send."""

_decode_small_spread = lru_cache(maxsize=256)(_decode_spread)


def encode_echo(packet: Echo) -> bytes:
    """An ECHO packet; names that do not fit are left out, which makes it a `lost` one."""
    names, size, fitting = b"", _ECHO.size, 0
    for name in packet.robots:
        size += 1 + len(name)
        if size > MAX_PAYLOAD:
            break
        fitting += 1
    names = b"".join(packed(name) for name in packet.robots[:fitting])
    lost = packet.lost or fitting < len(packet.robots)
    flags = lost | packet.orphan << 1
    return _ECHO.pack(ECHO, flags, packet.ttl, packet.incarnation, packet.sequence, fitting) + names


def decode_echo(data: bytes) -> Echo:
    """An ECHO packet."""
    if len(data) < _ECHO.size:
        raise FrameError(f"ECHO of {len(data)} bytes: it has at least {_ECHO.size}")
    _, flags, ttl, incarnation, sequence, count = _ECHO.unpack_from(data)
    if flags > 3:
        raise FrameError(f"ECHO flags {flags:#x}: bits 0 and 1 are known")
    reader = Reader(data, _ECHO.size)
    robots = tuple([reader.name() for _ in range(count)])
    reader.end()
    return Echo(incarnation, sequence, robots, bool(flags & 1), bool(flags & 2), ttl)


def encode_digests(origins: Mapping[str, tuple[int, int]], *, answer: bool) -> list[bytes]:
    """DIGEST packets that cover all names."""
    packets: list[bytes] = []
    names = sorted(origins)
    at, low = 0, ""
    while True:
        body, start = b"", at
        while at < len(names) and len(body) < MAX_DIGEST:
            body += packed(names[at]) + _DIGEST_ENTRY.pack(*origins[names[at]])
            at += 1
        high = names[at - 1] if at < len(names) else ""
        head = _DIGEST.pack(DIGEST, answer, at - start) + packed(low) + packed(high)
        packets.append(head + body)
        if at == len(names):
            return packets
        low = high


def decode_digest(data: bytes) -> Digest:
    """A DIGEST packet."""
    if len(data) < _DIGEST.size:
        raise FrameError(f"DIGEST of {len(data)} bytes: it has at least {_DIGEST.size}")
    _, flags, count = _DIGEST.unpack_from(data)
    if flags > 1:
        raise FrameError(f"DIGEST flags {flags:#x}: bit 0 is known")
    reader = Reader(data, _DIGEST.size)
    low, high = reader.name(empty=True), reader.name(empty=True)
    origins: dict[str, tuple[int, int]] = {}
    for _ in range(count):
        name = reader.name()
        incarnation, checksum = reader.unpack(_DIGEST_ENTRY)
        origins[name] = (incarnation, checksum)
    reader.end()
    return Digest(low, high, origins, bool(flags))


def encode_summary(total: int) -> bytes:
    """A SUMMARY packet: the checksum of a whole digest."""
    return _SUMMARY.pack(SUMMARY, 0, total)


def decode_summary(data: bytes) -> int:
    """A SUMMARY packet."""
    if len(data) != _SUMMARY.size or data[1]:
        raise FrameError(f"SUMMARY of {len(data)} bytes, flags {data[1:2]!r}: it has {_SUMMARY.size} and none")
    total: int = _SUMMARY.unpack(data)[2]
    return total


def encode_halts(halt: Halt) -> list[bytes]:
    """HALT packets: each may be understood without the others."""
    stops = [packed(name) + _MARK.pack(*mark) + packed(reason, MAX_REASON)
             for name, (mark, reason) in sorted(halt.stops.items())]  # fmt: skip
    arms = [packed(name) + _MARK.pack(*mark) for name, mark in sorted(halt.arms.items())]
    packets = []
    # Stops first: should the rest be lost, the swarm rests.
    for part in _parts(stops):
        packets.append(_HALT.pack(HALT, len(part), 0) + b"".join(part))
    for part in _parts(arms):
        packets.append(_HALT.pack(HALT, 0, len(part)) + b"".join(part))
    return packets


def _parts(entries: list[bytes]) -> list[list[bytes]]:
    return [entries[at : at + _HALT_ENTRIES] for at in range(0, len(entries), _HALT_ENTRIES)]


def decode_halt(data: bytes) -> Halt:
    """A HALT packet. Each stop that can be read counts, whatever follows it: another release may have more to say. A
    re-arm counts only in a packet that is understood to its end."""
    if len(data) < _HALT.size:
        raise FrameError(f"HALT of {len(data)} bytes: it has at least {_HALT.size}")
    _, stops, arms = _HALT.unpack_from(data)
    reader = Reader(data, _HALT.size)
    halt = Halt({}, {})
    try:
        for _ in range(stops):
            name, mark = reader.name(), Mark(*reader.unpack(_MARK))
            halt.stops[name] = (mark, reader.octets()[:MAX_REASON].decode(errors="ignore"))
        for _ in range(arms):
            name = reader.name()
            halt.arms[name] = Mark(*reader.unpack(_MARK))
        reader.end()
    except FrameError:
        if not halt.stops:
            raise
        halt.arms.clear()
    return halt


def encode_advertisement(packet: Advertisement) -> bytes:
    """The payload of a flooded LSA."""
    names = b"".join(packed(name) + _METRIC.pack(time) for name, time in sorted(packet.neighbours.items()))
    heard = packet.heard.to_bytes((packet.heard.bit_length() + 7) // 8, "little")
    twins = packet.twins[:MAX_TWINS]
    flags = (
        packet.leaving | bool(packet.topology) << 1 | bool(heard) << 2 | bool(packet.process) << 3 | bool(twins) << 4
    )
    tail = (_FIRST.pack(packet.topology) if packet.topology else b"") + (bytes((len(heard),)) + heard if heard else b"")
    tail += _FIRST.pack(packet.process) if packet.process else b""
    tail += bytes((len(twins),)) + b"".join(map(packed, twins)) if twins else b""
    return _LSA.pack(flags, len(packet.neighbours)) + names + tail


def decode_advertisement(data: bytes) -> Advertisement:
    """The payload of a flooded LSA. Most only repeat what is known: small ones are not taken apart again."""
    return _decode_small_advertisement(data) if len(data) <= _SMALL else _decode_advertisement(data)


def _decode_advertisement(data: bytes) -> Advertisement:
    if len(data) < _LSA.size:
        raise FrameError(f"LSA of {len(data)} bytes: it has at least {_LSA.size}")
    flags, count = _LSA.unpack_from(data)
    if flags > 31:
        raise FrameError(f"LSA flags {flags:#x}: bits 0 to 4 are known")
    reader = Reader(data, _LSA.size)
    neighbours: dict[str, int] = {}
    for _ in range(count):
        name = reader.name()
        (neighbours[name],) = reader.unpack(_METRIC)
    topology = reader.unpack(_FIRST)[0] if flags & 2 else 0
    heard = int.from_bytes(reader.octets(), "little") if flags & 4 else 0
    process = reader.unpack(_FIRST)[0] if flags & 8 else 0
    count = reader.unpack(_COUNT)[0] if flags & 16 else 0
    if count > MAX_TWINS:
        raise FrameError(f"LSA with {count} names of two robots: at most {MAX_TWINS}")
    twins = tuple(reader.name() for _ in range(count))
    reader.end()
    return Advertisement(neighbours, bool(flags & 1), topology, heard, process, twins)


_decode_small_advertisement = lru_cache(maxsize=1024)(_decode_advertisement)


# -- unicast channels ------------------------------------------------------------------------------------------


def encode_message(packet: Message) -> bytes:
    """A MESSAGE packet."""
    head = _MESSAGE.pack(MESSAGE, packet.ttl, packet.incarnation, packet.number)
    return head + packed(packet.sender) + packed(packet.to) + packed(packet.key, 255) + packet.payload


def decode_message(data: bytes) -> Message:
    """A MESSAGE packet."""
    if len(data) < _MESSAGE.size:
        raise FrameError(f"MESSAGE of {len(data)} bytes: it has at least {_MESSAGE.size}")
    _, ttl, incarnation, number = _MESSAGE.unpack_from(data)
    reader = Reader(data, _MESSAGE.size)
    sender, to, key = reader.name(), reader.name(), reader.key()
    return Message(sender, to, incarnation, number, key, data[reader.at :], ttl)


def encode_ack(packet: Ack) -> bytes:
    """An ACK packet."""
    head = _ACK.pack(ACK, packet.ttl, packet.refused, packet.incarnation, packet.number)
    return head + packed(packet.sender) + packed(packet.to)


def decode_ack(data: bytes) -> Ack:
    """An ACK packet."""
    if len(data) < _ACK.size:
        raise FrameError(f"ACK of {len(data)} bytes: it has at least {_ACK.size}")
    _, ttl, refused, incarnation, number = _ACK.unpack_from(data)
    if refused > 1:
        raise FrameError(f"ACK says {refused}: 0 and 1 are known")
    reader = Reader(data, _ACK.size)
    sender, to = reader.name(), reader.name()
    reader.end()
    return Ack(sender, to, incarnation, number, bool(refused), ttl)


# -- inside ----------------------------------------------------------------------------------------------------


def sorted_names(names: Iterable[str]) -> tuple[str, ...]:
    """Robots' names as results show them: r2 before r10."""
    return tuple(sorted(names, key=lambda name: (len(name), name)))
