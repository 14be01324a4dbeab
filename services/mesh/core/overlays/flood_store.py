"""The memory of every origin's floods: which numbers a robot has seen, and the latest values to pass on.

A flood is named by (origin, incarnation of the origin, sequence). An incarnation is a time in microseconds, so that a
robot's next one is higher; should its clock have gone back it hears of its old one from a neighbour and goes above
that. A higher incarnation makes everything of the lower one void.

`CatchUp` is how neighbours hand each other the floods that one of them lacks. They compare checksums of the latest
values when their link comes up, and every 30 s: whatever differs is sent. What the queue of a link had no room for
waits here, and is offered to it again.
"""

from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import NamedTuple

from services.mesh.core.actions import Emit, Transmit
from services.mesh.core.bulk.numbered import SeenNumbers
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import BULK, FLOOD
from swarm.messages.keys import key as key_of
from swarm.messages.keys import parse

WINDOW = 2048
"""Floods of one origin that may overtake each other: more than wait in a link's queue and for it."""

KEPT_EACH = 64
"""Latest values kept of one origin; a value under a further key is carried, but not kept."""

KEPT_BYTES = 4 * 1024 * 1024
"""Bytes of all kept values together; past that likewise."""

_OVERHEAD = 200
"""Bytes that a kept value costs beside its payload, counted in `KEPT_BYTES`."""

NEW, DUPLICATE, OLD = "new", "duplicate", "old"
"""What a flood is to this robot."""


class Kept(NamedTuple):
    """The latest value of one key."""

    sequence: int
    priority: int
    payload: bytes

    @property
    def size(self) -> int:
        """Bytes it counts for."""
        return len(self.payload) + _OVERHEAD


@dataclass(eq=False)
class Origin:
    """The floods of one robot that are known."""

    incarnation: int
    window: SeenNumbers = field(default_factory=lambda: SeenNumbers(WINDOW))
    latest: dict[str, Kept] = field(default_factory=dict)
    floor: int = 0
    """Values up to this sequence were forgotten and are not to come back."""
    checksum: int = 0
    """The checksum of keys and sequences of the kept values, in any order."""


class Store:
    """Keeps what is known of the floods of each origin. The caller has checked that origins are robots of the swarm."""

    def __init__(self) -> None:
        self._origins: dict[str, Origin] = {}
        self._bytes = 0
        self.unkept = 0
        """Values that were carried but not kept."""

    def __len__(self) -> int:
        return sum(len(origin.latest) for origin in self._origins.values())

    def incarnation(self, name: str) -> int:
        """Return the newest incarnation heard of; 0 = none."""
        origin = self._origins.get(name)
        return 0 if origin is None else origin.incarnation

    def begin(self, name: str, incarnation: int) -> Origin:
        """Everything that was known of an origin is void: it has begun anew."""
        self._drop(name)
        origin = self._origins[name] = Origin(incarnation)
        return origin

    def _current(self, name: str, incarnation: int) -> Origin | None:
        """Return an origin, begun anew where `incarnation` is a newer one; None where it is an earlier one."""
        origin = self._origins.get(name)
        if origin is None or incarnation > origin.incarnation:
            return self.begin(name, incarnation)
        return origin if incarnation == origin.incarnation else None

    def take(self, name: str, key: str, packet: packets.Spread, priority: int) -> str:
        """Tell what a flood is: new (and noted from now on), a duplicate, or of an earlier incarnation. A latest value
        that is only announced is not noted: it is taken when it has come."""
        if (origin := self._current(name, packet.incarnation)) is None:
            return OLD
        announced = packet.latest and packet.size > 0
        unseen = announced or origin.window.add(packet.sequence)
        if packet.latest:
            # Whatever the window knows: a value is new if it is newer than the one that is kept. So repair can bring
            # what was missed long ago, and an older value never takes the place of a newer one.
            old = origin.latest.get(key)
            if packet.sequence <= (old.sequence if old is not None else origin.floor):
                unseen = False
            elif not announced and self._keep(origin, key, Kept(packet.sequence, priority, packet.payload)):
                unseen = True
        return NEW if unseen else DUPLICATE

    def payload(self, name: str, incarnation: int, sequence: int) -> bytes | None:
        """Return the latest value of that number."""
        origin = self._origins.get(name)
        if origin is None or origin.incarnation != incarnation:
            return None
        return next((kept.payload for kept in origin.latest.values() if kept.sequence == sequence), None)

    def has_seen(self, name: str, sequence: int) -> bool:
        """Note a sequence; whether it was seen before."""
        return not self._origins[name].window.add(sequence)

    def kept(self, name: str) -> list[tuple[str, Kept]]:
        """Return the latest values of an origin."""
        origin = self._origins.get(name)
        return [] if origin is None else list(origin.latest.items())

    def one(self, name: str, key: str) -> Kept | None:
        """Return the latest value of one key."""
        origin = self._origins.get(name)
        return None if origin is None else origin.latest.get(key)

    def forget(self, name: str) -> None:
        """Drop the latest values of an origin that is gone, for good: neighbours that still keep them will offer them
        again."""
        origin = self._origins.get(name)
        if origin is not None and origin.latest:
            floor = max(kept.sequence for kept in origin.latest.values())
            window, incarnation = origin.window, origin.incarnation
            origin = self.begin(name, incarnation)
            origin.window, origin.floor = window, floor

    def take_again(self, name: str) -> None:
        """Keep values of any age again of an origin that was forgotten."""
        if (origin := self._origins.get(name)) is not None:
            origin.floor = 0

    def digest(self) -> dict[str, tuple[int, int]]:
        """Incarnation and checksum of every origin."""
        return {name: (origin.incarnation, origin.checksum) for name, origin in self._origins.items()}

    def summary(self, skip: Collection[str] = ()) -> int:
        """Return a checksum of the whole digest."""
        total = 0
        for name, (incarnation, checksum) in self.digest().items():
            if name not in skip:
                total ^= _checksum(name, incarnation, checksum)
        return total

    def lacking(self, low: str, high: str, theirs: dict[str, tuple[int, int]]) -> Iterator[str]:
        """Origins from a digest's range of names whose latest values differ from ours."""
        for name, origin in self._origins.items():
            if low < name and (not high or name <= high) and theirs.get(name) != (origin.incarnation, origin.checksum):
                yield name

    # -- inside ------------------------------------------------------------------------------------------------

    def _keep(self, origin: Origin, key: str, value: Kept) -> bool:
        """Keep a value in the place of an older one; False where there is no room, and nothing of this age or older
        will be kept or taken for new any more."""
        old = origin.latest.pop(key, None)
        if old is not None:
            origin.checksum ^= _checksum(key, old.sequence)
            self._bytes -= old.size
        if len(origin.latest) >= KEPT_EACH or self._bytes + value.size > KEPT_BYTES:
            origin.floor = max(origin.floor, value.sequence)
            self.unkept += 1
            return False
        origin.checksum ^= _checksum(key, value.sequence)
        origin.latest[key] = value
        self._bytes += value.size
        return True

    def _drop(self, name: str) -> None:
        origin = self._origins.pop(name, None)
        if origin is not None:
            self._bytes -= sum(kept.size for kept in origin.latest.values())


def _checksum(*parts: str | int) -> int:
    """Return 32 bits of a hash. Checksums are joined by exclusive or, so a CRC does not do: of numbers that differ by
    the same bits in two texts it makes the same difference, and the two cancel each other out."""
    return int.from_bytes(blake2b(" ".join(map(str, parts)).encode(), digest_size=4).digest(), "little")


COMPARE_PERIOD = 30.0
"""Seconds between two comparisons of what two neighbours keep, each spread by a fifth. Repairs what full queues
dropped."""

ANSWER_PERIOD = 2.0
"""Seconds between two whole digests to one neighbour, the one at link-up aside."""

REPAIR_PERIOD = 0.1
REPAIR_BYTES = 4096
"""Missing values leave in portions, 41 kB/s: half of what a Bluetooth link carries, in the class of each value."""

MAX_BACKLOG = 256
MAX_BACKLOG_BYTES = 256 * 1024
"""Packets for one neighbour that its queue had no room for, and their bytes; more are lost."""

COUNTERS = ("flood_lost", "repaired")

_NEVER = float("inf")


@dataclass(eq=False)
class Neighbour:
    """The values that are under way to one neighbour."""

    compare_at: float
    answered_at: float = -_NEVER
    missing: dict[tuple[str, str], None] = field(default_factory=dict)
    """Values to be sent, by origin and key."""
    backlog: deque[Transmit] = field(default_factory=deque)
    backlog_bytes: int = 0
    repair_at: float = _NEVER


class CatchUp:
    """All neighbours of one robot. Calls with `now` must not go back in time."""

    def __init__(
        self, me: str, store: Store, *, emit: Emit, random: Callable[[], float], counters: Counter[str]
    ) -> None:
        """`random` gives uniform numbers from 0 up to 1."""
        self._store = store
        self._emit = emit
        self._random = random
        self._counters = counters
        self._digest_key = key_of(me, "mesh", "digest")
        self.links: dict[str, Neighbour] = {}

    def link_up(self, peer: str, now: float) -> None:
        """Tell a new neighbour what we keep."""
        self.links[peer] = Neighbour(now + self._compare_period())
        self._send_digest(peer, answer=False)

    def unlink(self, peer: str) -> None:
        """Send nothing more to a neighbour that is gone."""
        self.links.pop(peer, None)

    def spread(self, packet: Transmit) -> None:
        """Send a flood, behind those that wait here: who gets too many later ones first takes it for an old one."""
        link = self.links[packet.peer]
        if link.backlog and packet.priority == BULK and not packet.latest:
            self._keep(link, packet)
        else:
            self._emit(packet)

    def pushed_back(self, packet: Transmit, now: float) -> None:
        """The queue of a link had no room for a packet."""
        link = self.links.get(packet.peer)
        if link is None:
            return
        if packet.latest:
            link.missing[parse(packet.key).robot, packet.key] = None
        else:
            self._keep(link, packet)
        link.repair_at = min(link.repair_at, now + REPAIR_PERIOD)

    def on_summary(self, peer: str, total: int, now: float) -> None:
        """Compare a neighbour's checksum of everything with our own."""
        if total != self._store.summary():
            self._answer(peer, now, answer=True)

    def on_old(self, peer: str, now: float) -> None:
        """Tell a neighbour which incarnation of it is known here: its own flood has an earlier one."""
        self._answer(peer, now, answer=False)

    def on_digest(self, peer: str, digest: packets.Digest, now: float) -> None:
        """Compare a neighbour's digest with our own."""
        theirs, _ = digest.origins.get(peer, (0, 0))
        if theirs > self._store.incarnation(peer):
            self._store.begin(peer, theirs)  # it has begun anew: nobody else can know that better
        link, differs = self.links[peer], False
        for origin in self._store.lacking(digest.low, digest.high, digest.origins):
            differs = True
            if digest.origins.get(origin, (0, 0))[0] <= self._store.incarnation(origin):
                link.missing |= {(origin, key): None for key, _ in self._store.kept(origin)}
        if link.missing and link.repair_at == _NEVER:
            self._repair(peer, link, now)
        if digest.answer and (differs or digest.origins.keys() - self._store.digest().keys()):
            self._answer(peer, now, answer=False)

    def handle_timer(self, now: float) -> None:
        """Do everything that is due at `now`."""
        for peer, link in self.links.items():
            if now >= link.repair_at:
                self._repair(peer, link, now)
            if now >= link.compare_at:
                link.compare_at = now + self._compare_period()
                self._transmit(peer, packets.encode_summary(self._store.summary()))

    def next_deadline(self) -> float:
        """Return the time at which `handle_timer` must be called."""
        return min((min(link.repair_at, link.compare_at) for link in self.links.values()), default=_NEVER)

    # -- inside ------------------------------------------------------------------------------------------------

    def _keep(self, link: Neighbour, packet: Transmit) -> None:
        if len(link.backlog) < MAX_BACKLOG and link.backlog_bytes + len(packet.payload) <= MAX_BACKLOG_BYTES:
            link.backlog.append(packet)
            link.backlog_bytes += len(packet.payload)
        else:
            self._counters["flood_lost"] += 1

    def _compare_period(self) -> float:
        return COMPARE_PERIOD * (0.8 + 0.4 * self._random())

    def _send_digest(self, peer: str, *, answer: bool) -> None:
        for data in packets.encode_digests(self._store.digest(), answer=answer):
            self._transmit(peer, data)

    def _answer(self, peer: str, now: float, *, answer: bool) -> None:
        link = self.links[peer]
        if now >= link.answered_at + ANSWER_PERIOD:
            link.answered_at = now
            self._send_digest(peer, answer=answer)

    def _repair(self, peer: str, link: Neighbour, now: float) -> None:
        size = 0
        backlog, link.backlog, link.backlog_bytes = link.backlog, deque(), 0
        for packet in backlog:
            self._emit(packet)  # the link takes as much as it can, and pushes the rest back
        while link.missing and size < REPAIR_BYTES:
            origin, key = next(iter(link.missing))
            del link.missing[origin, key]
            kept = self._store.one(origin, key)
            if kept is not None:
                spread = packets.Spread(self._store.incarnation(origin), kept.sequence, kept.payload, latest=True)
                if len(kept.payload) > packets.MAX_SPREAD:
                    spread = spread._replace(payload=b"", size=len(kept.payload))
                data = packets.encode_spread(spread)
                size += len(data)
                self._counters["repaired"] += 1
                self._emit(Transmit(peer, FLOOD, key, data, kept.priority, latest=True))
        link.repair_at = now + REPAIR_PERIOD if link.missing or link.backlog else _NEVER

    def _transmit(self, peer: str, data: bytes) -> None:
        self._emit(Transmit(peer, FLOOD, self._digest_key, data, BULK))
