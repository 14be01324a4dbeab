"""How neighbours hand each other the floods that one of them lacks.

They compare checksums of the latest values when their link comes up, and every 30 s: whatever differs is sent. What
the queue of a link had no room for waits here, and is offered to it again.
"""

from collections import Counter, deque
from collections.abc import Callable

from services.mesh.core.actions import Emit, Transmit
from services.mesh.core.overlays.flood_store import Store
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import BULK, FLOOD
from services.mesh.core.wire.packets import Digest, Spread
from swarm.messages.keys import key as key_of
from swarm.messages.keys import parse

COMPARE_PERIOD = 30.0
"""s between two comparisons of what two neighbours keep, each spread by a fifth. Repairs what full queues dropped."""

ANSWER_PERIOD = 2.0
"""s between two whole digests to one neighbour, the one at link-up aside."""

REPAIR_PERIOD = 0.1
REPAIR_BYTES = 4096
"""Missing values leave in portions, 41 kB/s: half of what a Bluetooth link carries, in the class of each value."""

MAX_BACKLOG = 256
MAX_BACKLOG_BYTES = 256 * 1024
"""Packets for one neighbour that its queue had no room for, and their bytes; more are lost."""

COUNTERS = ("flood_lost", "repaired")

_NEVER = float("inf")


class Neighbour:
    """What is under way to one neighbour."""

    __slots__ = ("answered_at", "backlog", "backlog_bytes", "compare_at", "missing", "repair_at")

    def __init__(self, compare_at: float) -> None:
        self.compare_at = compare_at
        self.answered_at = -_NEVER
        self.missing: dict[tuple[str, str], None] = {}
        """Values to be sent, by origin and key."""
        self.backlog: deque[Transmit] = deque()
        self.backlog_bytes = 0
        self.repair_at = _NEVER


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
        """A neighbour is gone: nothing goes to it any more."""
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
        """A neighbour's checksum of everything."""
        if total != self._store.summary():
            self._answer(peer, now, answer=True)

    def on_digest(self, peer: str, digest: Digest, now: float) -> None:
        """What a neighbour keeps."""
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
        """Whatever is due."""
        for peer, link in self.links.items():
            if now >= link.repair_at:
                self._repair(peer, link, now)
            if now >= link.compare_at:
                link.compare_at = now + self._compare_period()
                self._transmit(peer, packets.encode_summary(self._store.summary()))

    def next_deadline(self) -> float:
        """When `handle_timer` wants to be called."""
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
                spread = Spread(self._store.incarnation(origin), kept.sequence, kept.payload, latest=True)
                if len(kept.payload) > packets.MAX_SPREAD:
                    spread = spread._replace(payload=b"", size=len(kept.payload))
                data = packets.encode_spread(spread)
                size += len(data)
                self._counters["repaired"] += 1
                self._emit(Transmit(peer, FLOOD, key, data, kept.priority, latest=True))
        link.repair_at = now + REPAIR_PERIOD if link.missing or link.backlog else _NEVER

    def _transmit(self, peer: str, data: bytes) -> None:
        self._emit(Transmit(peer, FLOOD, self._digest_key, data, BULK))
