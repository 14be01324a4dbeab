"""What a robot remembers of every origin's floods: which numbers it has seen, and the latest values to hand on.

A flood is named by (origin, incarnation of the origin, sequence). An incarnation is a time in microseconds, so that
a robot's next one is higher; should its clock have gone back it hears of its old one from a neighbour and goes above
that. A higher incarnation makes everything of the lower one void.
"""

import zlib
from collections.abc import Collection, Iterator
from typing import NamedTuple

from services.mesh.core.wire.packets import Spread
from services.mesh.core.wire.seen_numbers import Window

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


class Origin:
    """What is known of one robot's floods."""

    __slots__ = ("checksum", "floor", "incarnation", "latest", "window")

    def __init__(self, incarnation: int) -> None:
        self.incarnation = incarnation
        self.window = Window(WINDOW)
        self.latest: dict[str, Kept] = {}
        self.floor = 0
        """Values up to this sequence were forgotten and are not to come back."""
        self.checksum = 0
        """Of keys and sequences of the kept values, in any order."""


class Store:
    """All origins. There are as many as robots in the swarm: who calls has checked their names."""

    def __init__(self) -> None:
        self._origins: dict[str, Origin] = {}
        self._bytes = 0
        self.unkept = 0
        """Values that were carried but not kept."""

    def __len__(self) -> int:
        return sum(len(origin.latest) for origin in self._origins.values())

    def incarnation(self, name: str) -> int:
        """The newest incarnation heard of; 0 = none."""
        origin = self._origins.get(name)
        return 0 if origin is None else origin.incarnation

    def begin(self, name: str, incarnation: int) -> Origin:
        """Everything that was known of an origin is void: it has begun anew."""
        self._drop(name)
        origin = self._origins[name] = Origin(incarnation)
        return origin

    def take(self, name: str, key: str, packet: Spread, priority: int) -> str:
        """What a flood is: new (and noted from now on), a duplicate, or of an earlier incarnation."""
        origin = self._origins.get(name)
        if origin is None or packet.incarnation > origin.incarnation:
            origin = self.begin(name, packet.incarnation)
        elif packet.incarnation < origin.incarnation:
            return OLD
        unseen = origin.window.add(packet.sequence)
        if packet.latest:
            # Whatever the window knows: a value is new if it is newer than the one that is kept. So repair can bring
            # what was missed long ago, and an older value never takes the place of a newer one.
            old = origin.latest.get(key)
            if packet.sequence <= (old.sequence if old is not None else origin.floor):
                unseen = False
            elif self._keep(origin, key, Kept(packet.sequence, priority, packet.payload)):
                unseen = True
        return NEW if unseen else DUPLICATE

    def sight(self, name: str, key: str, packet: Spread) -> str:
        """What an announcement is, as `take` of what it announces will say unless that has come meanwhile. Of latest
        values nothing is noted."""
        if not packet.latest:
            return self.take(name, key, packet, 0)
        origin = self._origins.get(name)
        if origin is None or packet.incarnation > origin.incarnation:
            origin = self.begin(name, packet.incarnation)
        elif packet.incarnation < origin.incarnation:
            return OLD
        old = origin.latest.get(key)
        return NEW if packet.sequence > (old.sequence if old is not None else origin.floor) else DUPLICATE

    def payload(self, name: str, incarnation: int, sequence: int) -> bytes | None:
        """The latest value of that number."""
        origin = self._origins.get(name)
        if origin is None or origin.incarnation != incarnation:
            return None
        return next((kept.payload for kept in origin.latest.values() if kept.sequence == sequence), None)

    def has_seen(self, name: str, sequence: int) -> bool:
        """Note a sequence; whether it was seen before."""
        return not self._origins[name].window.add(sequence)

    def kept(self, name: str) -> list[tuple[str, Kept]]:
        """The latest values of an origin."""
        origin = self._origins.get(name)
        return [] if origin is None else list(origin.latest.items())

    def one(self, name: str, key: str) -> Kept | None:
        """The latest value of one key."""
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

    def digest(self) -> dict[str, tuple[int, int]]:
        """Incarnation and checksum of every origin."""
        return {name: (origin.incarnation, origin.checksum) for name, origin in self._origins.items()}

    def summary(self, skip: Collection[str] = ()) -> int:
        """A checksum of the whole digest."""
        total = 0
        for name, (incarnation, checksum) in self.digest().items():
            if name not in skip:
                total ^= zlib.crc32(f"{name} {incarnation} {checksum}".encode())
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


def _checksum(key: str, sequence: int) -> int:
    return zlib.crc32(f"{key} {sequence}".encode())
