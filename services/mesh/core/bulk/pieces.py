"""The pieces of a large message: their packets, which of them a robot lacks, and which it asks for next.

**Packets**, byte by byte in docs/reference/network/overlay-packets.md. They travel as unicast does, hop by hop; a robot
on the way reads no more than the head. Every decoder raises `FrameError` for bytes that are none of its packets, and
nothing else.

    OFFER   here is a message for you, so large, under this key       WANT   give me these pieces of it
    PIECE   one of them                                               STATE  delivered, refused, or: ask later
    GONE    I do not have it (any more)

**Pace.** A robot has at most `ASKED` pieces of another robot under way, as a BitTorrent peer has a fixed number of
requests. Those that a link cannot carry yet wait in the queue of a robot on the way, where all else overtakes them.
Only a link's window (`link.flow`) follows the rate of the link.
"""

import struct
from collections import deque
from collections.abc import Collection, Iterable
from typing import NamedTuple

from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import MAX_MESSAGE
from services.mesh.core.wire.packets import PacketReader, packed
from swarm.errors import FrameError

OFFER, WANT, PIECE, STATE, GONE = 3, 4, 5, 6, 7
"""Kinds of packets on unicast channels, besides `packets.MESSAGE` and `packets.ACK`."""

DONE, REFUSED, LATER = 0, 1, 2
"""What a STATE says."""

SIZE = 1880
"""Bytes of a message in one piece, the last one aside: with all headers six fragments of a link."""

MAX_RANGES = 32
MAX_WANTED = 128
"""Pieces of one WANT, and runs of neighbouring ones that they are told by."""

LEAST_MESSAGE = packets.UNICAST_ROOM + 1
"""Bytes of the smallest message that is offered. Bookkeeping costs a receiver about 1 kB a message, and the room for
messages is counted in bytes: without this bound a peer could offer millions of messages of one byte."""

_HEAD = struct.Struct("<BBBQI")
_OFFER = struct.Struct("<I")
_WANT = struct.Struct("<HB")
_RANGE = struct.Struct("<HH")
_PIECE = struct.Struct("<H")
_OF_FLOOD = 1


class MessageId(NamedTuple):
    """Names one large message in the whole swarm."""

    origin: str
    incarnation: int
    number: int
    """A flood's sequence; else it counts what the origin offered to one robot, from 1."""
    flood: bool


class Packet(NamedTuple):
    """The common part of all kinds of packets."""

    kind: int
    sender: str
    to: str
    id: MessageId
    body: bytes
    ttl: int = 0


class WantBody(NamedTuple):
    """Body of a WANT."""

    have: int
    """Pieces that are there already."""
    indexes: tuple[int, ...]


def count_of(total: int) -> int:
    """Pieces of a message of so many bytes."""
    return -(-total // SIZE)


def encode(packet: Packet) -> bytes:
    """Encode a packet of any kind."""
    id = packet.id
    head = _HEAD.pack(packet.kind, packet.ttl, _OF_FLOOD if id.flood else 0, id.incarnation, id.number)
    origin = packed(id.origin) if id.flood else b""
    return head + packed(packet.sender) + packed(packet.to) + origin + packet.body


def decode(data: bytes) -> Packet:
    """Decode a packet of any kind. The origin is the sender of the offer, unless the message is a flood's."""
    reader = PacketReader(data)
    kind, ttl, flags, incarnation, number = reader.unpack(_HEAD)
    # A flood is announced by a SPREAD. An OFFER of one would pass by the bounds of both overlays.
    wrong_flags = flags > _OF_FLOOD or (flags and kind in (OFFER, STATE))
    if not OFFER <= kind <= GONE or wrong_flags or not number:
        raise FrameError(f"packet kind {kind}, flags {flags:#x}, number {number} about a large message: not known")
    sender, to = reader.name(), reader.name()
    offers = to if kind in (WANT, STATE) else sender
    origin = reader.name() if flags else offers
    return Packet(kind, sender, to, MessageId(origin, incarnation, number, bool(flags)), data[reader.at :], ttl)


def passed_on(data: bytes) -> bytes:
    """Return a packet as a robot on its way passes it on: with one hop less to live."""
    return data[:1] + bytes((data[1] - 1,)) + data[2:]


def encode_offer(total: int, key: str) -> bytes:
    """Body of an OFFER."""
    return _OFFER.pack(total) + packed(key, 255)


def decode_offer(body: bytes) -> tuple[int, str]:
    """Return the number of bytes and the key of the message that is offered."""
    reader = PacketReader(body)
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


def decode_want(body: bytes) -> WantBody:
    """Decode the body of a WANT."""
    reader = PacketReader(body)
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
    return WantBody(have, tuple(indexes))


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


ASKED = 32
"""Pieces of one robot that may be under way. Their 60 kB keep nine of the thesis' links in a row busy (78 kB/s, 30 ms
each way, and 24 ms until a piece has passed a link), and the pieces of 20 robots fit into the queue of one link."""

REORDERED = 3
"""A piece counts as lost when another one comes that was asked for later by more than so many pieces."""


class Fetch:
    """One message on its way here, from one robot at a time."""

    def __init__(self, id: MessageId, total: int, now: float) -> None:
        self.id = id
        self.total = total
        self.count = count_of(total)
        self.have = 0
        """Pieces that are there."""
        self.repeated = 0
        """How often a piece was given up, or asked for again while it was still awaited."""
        self.heard = now
        """The time at which the last new piece came."""
        self.source: str | None = None
        """The robot that is asked now."""
        self.sources: deque[str] = deque()
        """The other robots that may have it."""
        self.stalled = False
        """Whether pieces of other messages came from its source, and none of it. Then one is asked for at a time."""
        self._parts: dict[int, bytes] = {}
        self._next = 0
        self._again: deque[int] = deque()
        self._asked: dict[int, int] = {}
        """The place of each piece in the order in which they were asked for."""
        self._places = 0
        self._given_up: set[int] = set()
        """Pieces that were given up once. Such a piece may come from the first time that it was asked for, so it does
        not show others to be lost."""
        self._since = now
        self._doubted = False
        """Whether `probe` was called since the last piece that was asked for once has come."""

    @property
    def asked(self) -> int:
        """Pieces asked for that have not come."""
        return len(self._asked)

    @property
    def waiting_since(self) -> float:
        """Return the time since which none of them has come, and no more were asked for; infinite where none is."""
        return self._since if self._asked else float("inf")

    @property
    def has_further(self) -> bool:
        """Return whether there are pieces that were not asked for yet."""
        return self._next < self.count

    def pick(self, now: float) -> int | None:
        """Return the next piece to ask for, noted as asked for; None where all are."""
        while self._again:
            index = self._again.popleft()
            if index not in self._parts:
                break
        else:
            if self._next >= self.count:
                return None
            index = self._next
            self._next += 1
        self._places += 1
        self._asked[index] = self._places
        self._since = now
        return index

    def probe(self, now: float) -> int | None:
        """Choose one more piece to ask for after a silence, noted as asked for; None where no piece is awaited.

        It is the next piece to ask for. Where there is none, it is the last one that is awaited. If that was tried
        before, all are given up, and it is the first of them. A piece that comes then shows all that were asked for
        before it to be lost.
        """
        if not self._asked:
            return None
        self._since = now
        index = self.pick(now)
        if index is None and self._doubted:
            self.ask_again()
            index = self.pick(now)
        elif index is None:
            index = next(reversed(self._asked))
            self.repeated += 1
        self._doubted = True
        return index

    def take(self, index: int, data: bytes, now: float) -> bool:
        """Take a piece, and give up those that it shows to be lost. False where it is not new, or was not asked for.
        Raises `FrameError`."""
        if index >= self.count or len(data) != min(SIZE, self.total - index * SIZE):
            raise FrameError(f"PIECE {index} of {len(data)} bytes: not one of {self.total} bytes in all")
        if index in self._parts:
            return False
        place = self._asked.pop(index, None)
        if place is None and index not in self._again:
            return False
        self._parts[index] = data
        self.have += 1
        self.heard = self._since = now
        self.stalled = False
        if place is not None and index not in self._given_up:
            before = place - (1 if self._doubted else REORDERED + 1)
            self._doubted = False
            lost = [each for each, other in self._asked.items() if other <= before]
            self._again += lost
            self._give_up(lost)
        return True

    def ask_again(self) -> None:
        """Give up the pieces that were asked for, and ask for them again later."""
        self._again.extendleft(reversed(self._asked))
        self._give_up(tuple(self._asked))

    def _give_up(self, indexes: Collection[int]) -> None:
        for index in indexes:
            del self._asked[index]
        self._given_up.update(indexes)
        self.repeated += len(indexes)

    def piece(self, index: int) -> bytes | None:
        """Return a piece that is here; None for others."""
        return self._parts.get(index)

    @property
    def complete(self) -> bool:
        """Return whether all pieces are here."""
        return self.have == self.count

    def payload(self) -> bytes:
        """Return the whole message."""
        return b"".join(self._parts[index] for index in range(self.count))
