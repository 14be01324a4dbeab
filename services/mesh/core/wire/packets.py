"""The packets of the overlays in DATA frames of their channels, byte by byte
(docs/reference/network/overlay-packets.md).

All numbers are little endian; names stand behind their length (u8). Every decoder raises `FrameError` for bytes
that are none of its packets, and nothing else.
"""

import struct
from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

from services.mesh.core.wire.frames import MAX_MESSAGE, MAX_PAYLOAD
from swarm.errors import FrameError, PayloadError
from swarm.messages.keys import is_name, parse


def packed(text: str, limit: int = 16) -> bytes:
    """Encode a text behind its length, u8; cut off at `limit` bytes."""
    data = text.encode()
    if len(data) > limit:
        data = data[:limit].decode(errors="ignore").encode()
    return bytes((len(data),)) + data


@lru_cache(maxsize=4096)
def _name(data: bytes) -> str:
    """Decode a robot's name. The results are kept: there are few names, and they come often."""
    text = data.decode("ascii", "replace")
    if not is_name(text):
        raise FrameError(f"{data!r} is not a robot's name")
    return text


class PacketReader:
    """Goes through a packet; raises `FrameError` where it ends too early."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.at = 0

    def unpack(self, layout: struct.Struct) -> tuple[int, ...]:
        """Read the next numbers."""
        end = self.at + layout.size
        if end > len(self._data):
            raise self._short()
        fields = layout.unpack_from(self._data, self.at)
        self.at = end
        return fields

    def name(self, *, empty: bool = False) -> str:
        """Return the next robot's name."""
        data = self._text(16)
        return "" if empty and not data else _name(data)

    def key(self) -> str:
        """Read the next key."""
        try:
            text = self._text(255).decode()
            parse(text)
        except UnicodeDecodeError:
            raise FrameError("overlay packet: a text is not UTF-8") from None
        except PayloadError as error:
            raise FrameError(f"overlay packet: {error}") from None
        return text

    def octets(self) -> bytes:
        """Return the next bytes behind their length, u8."""
        return self._text(255)

    def end(self) -> None:
        """Check that nothing follows."""
        if self.at != len(self._data):
            raise FrameError(f"overlay packet of {len(self._data)} bytes: {len(self._data) - self.at} too many")

    def _text(self, limit: int) -> bytes:
        if self.at >= len(self._data):
            raise self._short()
        start = self.at + 1
        end = start + self._data[self.at]
        if end - start > limit:
            raise FrameError(f"overlay packet: a text of {end - start} bytes, at most {limit} are allowed")
        if end > len(self._data):
            raise self._short()
        self.at = end
        return self._data[start:end]

    def _short(self) -> FrameError:
        return FrameError(f"overlay packet of {len(self._data)} bytes ends too early")


SPREAD, ECHO, DIGEST, SUMMARY, HALT, TOPOLOGY, KNOWN = 1, 2, 3, 4, 5, 6, 7
"""Kinds of packets on flood channels; the last three are made in `overlays.stop`, `topology`, `overlays.completion`."""

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
_MESSAGE = struct.Struct("<BBQI")
_ACK = struct.Struct("<BBBQI")

MAX_SPREAD = MAX_PAYLOAD - _SPREAD.size - _FIRST.size
"""Longest payload of a flood in one packet, in bytes."""

MAX_KNOWN = 1 + 255
"""Bytes that the robots in a SPREAD take at most."""

UNICAST_ROOM = MAX_PAYLOAD - _MESSAGE.size - 2 * 17 - 256
"""Longest payload of a unicast message in one packet, in bytes, whatever its names and key."""

MAX_DIGEST = 1024
"""Bytes of one DIGEST packet: it must not hold up what is urgent."""


class Spread(NamedTuple):
    """A flooded message. Its origin is the robot that its channel's key belongs to."""

    incarnation: int
    """The incarnation of the origin, which goes up with each of its starts."""
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
    """Bytes of the message where this only announces it (`overlays.large_messages`); the payload is empty then."""
    known: int = 0
    """The robots that have the flood, as far as the sender knows: bit i is robot i of all names, sorted. Only where all
    are to learn that all have it (`overlays.completion`), 0 elsewhere."""


class EchoPacket(NamedTuple):
    """The answer to a flood, on its way back to the origin."""

    incarnation: int
    sequence: int
    robots: tuple[str, ...]
    """The robots that were reached behind the sender, the sender included."""
    lost: bool = False
    """A link broke before its echo came: there may be more."""
    orphan: bool = False
    """The echo does not come from the far end of its edge but from a robot that lost its way back."""
    ttl: int = 0
    """Further hops an orphan may take."""


class Digest(NamedTuple):
    """The values that a neighbour holds of the origins whose names are above `low` and up to `high`."""

    low: str
    high: str
    """Empty = no bound."""
    origins: dict[str, tuple[int, int]]
    """Incarnation and checksum of the latest values, by origin."""
    answer: bool
    """The sender wants ours in return."""


class UnicastMessage(NamedTuple):
    """A unicast message on its way."""

    sender: str
    to: str
    incarnation: int
    """The incarnation of the sender."""
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
    """The robot that answers."""
    to: str
    """The robot whose message it was."""
    incarnation: int
    number: int
    refused: bool
    ttl: int


# -- flood channels --------------------------------------------------------------------------------------------


def kind_of(data: bytes) -> int:
    """Return the kind of a packet."""
    if not data:
        raise FrameError("overlay packet without a kind")
    return data[0]


def room(*, all_know: bool) -> int:
    """Longest payload of a flood in one packet, in bytes; `all_know`: where it names robots."""
    return MAX_SPREAD - MAX_KNOWN if all_know else MAX_SPREAD


def packed_bits(bits: int) -> bytes:
    """Encode a set of robots behind its length, u8: bit i is robot i of all names, sorted."""
    size = (bits.bit_length() + 7) // 8
    return bytes((size,)) + bits.to_bytes(size, "little")


def encode_spread(packet: Spread) -> bytes:
    """Encode a SPREAD packet: 14 bytes before the payload, 18 on the second try, and what `known` takes."""
    flags = packet.echo | packet.latest << 1 | bool(packet.first) << 2 | bool(packet.size) << 3
    flags |= bool(packet.known) << 4
    head = _SPREAD.pack(SPREAD, flags, packet.incarnation, packet.sequence)
    head += _FIRST.pack(packet.first) if packet.first else b""
    head += packed_bits(packet.known) if packet.known else b""
    return head + (_SIZE.pack(packet.size) if packet.size else packet.payload)


def decode_spread(data: bytes) -> Spread:
    """Decode a SPREAD packet. It comes once from each neighbour: a small one is taken apart only the first time."""
    return _decode_small_spread(data) if len(data) <= _SMALL else _decode_spread(data)


def _decode_spread(data: bytes) -> Spread:
    reader = PacketReader(data)
    _, flags, incarnation, sequence = reader.unpack(_SPREAD)
    if flags > 31 or (flags & 19).bit_count() > 1 or not sequence:
        raise FrameError(f"SPREAD flags {flags:#x}, sequence {sequence}: not known")
    (first,) = reader.unpack(_FIRST) if flags & 4 else (0,)
    if flags & 4 and not 0 < first < sequence:
        raise FrameError(f"SPREAD {sequence} claims to repeat {first}")
    known = int.from_bytes(reader.octets(), "little") if flags & 16 else 0
    if flags & 16 and not known:
        raise FrameError("SPREAD that nobody has")
    payload, size = data[reader.at :], 0
    if flags & 8:
        if len(payload) != _SIZE.size:
            raise FrameError(f"SPREAD announces a message by {len(payload)} bytes: it takes {_SIZE.size}")
        payload, (size,) = b"", _SIZE.unpack(payload)
        if not (least := room(all_know=bool(known))) < size <= MAX_MESSAGE:
            raise FrameError(f"SPREAD announces {size} bytes: {least + 1} to {MAX_MESSAGE} are allowed")
    return Spread(incarnation, sequence, payload, bool(flags & 1), bool(flags & 2), first, size, known)


_SMALL = 256
"""Bytes of a SPREAD whose decoded form is remembered: 256 of them take 130 kB, whatever peers send."""

_decode_small_spread = lru_cache(maxsize=256)(_decode_spread)


def encode_echo(packet: EchoPacket) -> bytes:
    """Encode an ECHO packet; names that do not fit are left out, which makes it a `lost` one."""
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


def decode_echo(data: bytes) -> EchoPacket:
    """Decode an ECHO packet."""
    reader = PacketReader(data)
    _, flags, ttl, incarnation, sequence, count = reader.unpack(_ECHO)
    if flags > 3:
        raise FrameError(f"ECHO flags {flags:#x}: bits 0 and 1 are known")
    robots = tuple([reader.name() for _ in range(count)])
    reader.end()
    return EchoPacket(incarnation, sequence, robots, bool(flags & 1), bool(flags & 2), ttl)


def encode_digests(origins: Mapping[str, tuple[int, int]], *, answer: bool) -> list[bytes]:
    """Return DIGEST packets that cover all names."""
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
    """Decode a DIGEST packet."""
    reader = PacketReader(data)
    _, flags, count = reader.unpack(_DIGEST)
    if flags > 1:
        raise FrameError(f"DIGEST flags {flags:#x}: bit 0 is known")
    low, high = reader.name(empty=True), reader.name(empty=True)
    origins: dict[str, tuple[int, int]] = {}
    for _ in range(count):
        name = reader.name()
        incarnation, checksum = reader.unpack(_DIGEST_ENTRY)
        origins[name] = (incarnation, checksum)
    reader.end()
    return Digest(low, high, origins, bool(flags))


def encode_summary(total: int) -> bytes:
    """Encode a SUMMARY packet: the checksum of a whole digest."""
    return _SUMMARY.pack(SUMMARY, 0, total)


def decode_summary(data: bytes) -> int:
    """Decode a SUMMARY packet."""
    if len(data) != _SUMMARY.size or data[1]:
        raise FrameError(f"SUMMARY of {len(data)} bytes, flags {data[1:2]!r}: it has {_SUMMARY.size} and none")
    total: int = _SUMMARY.unpack(data)[2]
    return total


# -- unicast channels ------------------------------------------------------------------------------------------


def encode_message(packet: UnicastMessage) -> bytes:
    """Encode a MESSAGE packet."""
    head = _MESSAGE.pack(MESSAGE, packet.ttl, packet.incarnation, packet.number)
    return head + packed(packet.sender) + packed(packet.to) + packed(packet.key, 255) + packet.payload


def decode_message(data: bytes) -> UnicastMessage:
    """Decode a MESSAGE packet."""
    reader = PacketReader(data)
    _, ttl, incarnation, number = reader.unpack(_MESSAGE)
    sender, to, key = reader.name(), reader.name(), reader.key()
    return UnicastMessage(sender, to, incarnation, number, key, data[reader.at :], ttl)


def encode_ack(packet: Ack) -> bytes:
    """Encode an ACK packet."""
    head = _ACK.pack(ACK, packet.ttl, packet.refused, packet.incarnation, packet.number)
    return head + packed(packet.sender) + packed(packet.to)


def decode_ack(data: bytes) -> Ack:
    """Decode an ACK packet."""
    reader = PacketReader(data)
    _, ttl, refused, incarnation, number = reader.unpack(_ACK)
    if refused > 1:
        raise FrameError(f"ACK says {refused}: 0 and 1 are known")
    sender, to = reader.name(), reader.name()
    reader.end()
    return Ack(sender, to, incarnation, number, bool(refused), ttl)
