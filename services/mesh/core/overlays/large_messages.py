"""Large messages of both overlays: one exchange of pieces (`bulk.exchange`), and those who want and have them.

A flood that is larger than a packet spreads an announcement, the message itself is fetched. The announcement takes
the way of every flood, so duplicates are suppressed and the echo is collected as ever. Each robot fetches the message
from the neighbour that announced it first, and hands the pieces on as they come: the message crosses each edge of the
tree that the announcement has drawn once, N - 1 times in all, while as a flood it would cross some twice. A robot
joins the echo when it has the whole message, so a complete flood means that.
"""

from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Collection
from dataclasses import dataclass, field

from services.mesh.core.bulk import pieces
from services.mesh.core.bulk.exchange import BulkExchange, total_of
from services.mesh.core.bulk.pieces import SIZE, MessageId, Packet
from services.mesh.core.bulk.transfers import Transfers
from services.mesh.core.overlays.completion import Completion
from services.mesh.core.overlays.echo import MAX_WAVES, Waves
from services.mesh.core.overlays.echo import FloodId as WaveId
from services.mesh.core.overlays.flood_store import NEW, Store
from services.mesh.core.wire.frames import BULK
from services.mesh.core.wire.packets import Spread

MAX_OWN_BYTES = 4 * 1024 * 1024
"""Bytes of own messages that are held to be fetched; more are refused."""

MAX_BYTES = 8 * 1024 * 1024
"""Bytes of all messages that are held, or on their way here, as announced."""

HOLD = 30.0
"""Seconds for which a message is held after the last one asked for a piece of it."""

SLOWEST = 10_000.0
"""bytes/s at which a large flood must get on for its echo to be waited for."""

MAX_DELIVERED = 256
"""Large floods of one origin that are remembered as delivered. Their numbers lie far apart: all floods are counted."""

COUNTERS = ("flood_large_refused",)

_NEVER = float("inf")


def patience(size: int) -> float:
    """s that a flood of so many bytes may take longer than a small one."""
    return size / SLOWEST


@dataclass(eq=False)
class _Coming:
    """A message on its way here."""

    key: str
    packet: Spread
    waves: deque[WaveId] = field(default_factory=lambda: deque(maxlen=MAX_WAVES))
    """The tries that wait for it. `Waves` forgets the oldest of more, so this does, too."""


@dataclass(eq=False)
class _Held:
    """A message that others may fetch."""

    payload: bytes
    until: float
    key: str
    """The key of a latest value; empty otherwise."""
    have: dict[str, int] = field(default_factory=dict)
    """Pieces that those who ask for more have."""


class LargeFloods:
    """Large messages of the flood overlay of one robot."""

    def __init__(
        self,
        me: str,
        store: Store,
        waves: Waves,
        completion: Completion,
        *,
        pass_on: Callable[[str, Spread, int, str | None], list[str]],
        deliver: Callable[[str, str, bytes, int, int], None],
        counters: Counter[str],
    ) -> None:
        """`pass_on(key, packet, priority, source)` sends to all neighbours but one and returns them. `exchange` is to
        be set before anything comes."""
        self._me = me
        self._store = store
        self._waves = waves
        self._completion = completion
        self._pass_on = pass_on
        self._deliver = deliver
        self._counters = counters
        self.exchange: BulkExchange
        self._coming: dict[MessageId, _Coming] = {}
        self._held: OrderedDict[MessageId, _Held] = OrderedDict()
        self._delivered: dict[str, tuple[int, deque[int]]] = {}
        """For each origin, its incarnation and the numbers of its large floods that were delivered."""

    def has_room(self, size: int) -> bool:
        """Return whether one more own message can be held."""
        own = sum(len(held.payload) for id, held in self._held.items() if id.origin == self._me)
        return own + size <= MAX_OWN_BYTES

    def hold(self, id: MessageId, payload: bytes, now: float, key: str = "") -> None:
        """Let others fetch a message for a while; with a key it takes the place of an older one of that key."""
        for older in [older for older, held in self._held.items() if key and held.key == key]:
            del self._held[older]
        self._held[id] = _Held(payload, now + HOLD, key)
        self._make_room(0, now)

    def has(self, id: MessageId) -> bytes | None:
        """Return a message that is held, or kept as the latest value of its key."""
        held = self._held.get(id)
        return held.payload if held is not None else self._store.payload(id.origin, id.incarnation, id.number)

    def wanted(self, id: MessageId, peer: str, have: int, now: float) -> None:
        """Somebody who has so many pieces asked for more."""
        if (held := self._held.get(id)) is not None:
            held.until = now + HOLD
            held.have[peer] = have

    def progress(self, id: MessageId) -> int:
        """Return the number of bytes that all who fetch a message from us have."""
        held = self._held.get(id)
        return min(min(held.have.values(), default=0) * SIZE, len(held.payload)) if held is not None else 0

    def announced(self, peer: str, origin: str, key: str, packet: Spread, verdict: str, now: float) -> None:
        """Take a neighbour's announcement of a message; `verdict`: `NEW` or `DUPLICATE`, by the store."""
        id = MessageId(origin, packet.incarnation, packet.first or packet.sequence, flood=True)
        wave = WaveId(origin, packet.incarnation, packet.sequence)
        first = wave._replace(sequence=id.number)
        if verdict != NEW or (packet.latest and self._newer_comes(key, packet)):
            self._counters["flood_duplicates"] += 1
            self.exchange.add_source(id, peer, now)
            if packet.echo:
                self._waves.again(wave, key, BULK, peer, now)
            elif packet.known:
                self._completion.heard(first, peer, packet.known, now)
            return
        coming = self._coming.get(id)
        there = self._was_delivered(id)
        if coming is None and not there:
            coming = self._begin(id, key, packet, peer, now)
            if coming is None and packet.latest:
                # Nothing notes that it was here: passed on it would come back, and again. Neighbours will compare.
                return
        if packet.known:
            known = self._completion.reached(
                first, key, BULK, peer, packet.known, now, has=there, life=patience(packet.size)
            )
            packet = packet._replace(known=known)
        others = self._pass_on(key, packet, BULK, peer)
        if packet.known:
            self._completion.spread(first, others, now)
        if packet.echo:
            if coming is not None:
                coming.waves.append(wave)
            robots = {self._me} if there else set()
            life = patience(packet.size)
            self._waves.join(wave, key, BULK, peer, others, now, robots, coming=coming is not None, life=life)

    def finished(self, id: MessageId, payload: bytes | None, now: float) -> None:
        """Take a message that was fetched; `payload` is None where it was given up."""
        coming = self._coming.pop(id)
        if payload is not None:
            packet = coming.packet._replace(payload=payload, size=0)
            if packet.latest:
                fresh = self._store.take(id.origin, coming.key, packet, BULK) == NEW
            else:
                fresh = self._store.incarnation(id.origin) == id.incarnation and not self._was_delivered(id)
                if fresh:
                    self._delivered[id.origin][1].append(id.number)
            self.hold(id, payload, now, coming.key if packet.latest else "")
            if fresh:
                self._deliver(id.origin, coming.key, payload, BULK, id.incarnation)
        for wave in coming.waves:
            self._waves.came(wave, now, complete=payload is not None)
        if payload is not None:
            self._completion.came(WaveId(id.origin, id.incarnation, id.number), now)

    def handle_timer(self, now: float) -> None:
        """Forget what nobody asks for any more."""
        for id in [id for id, held in self._held.items() if now >= held.until]:
            del self._held[id]

    def next_deadline(self) -> float:
        """Return the time at which `handle_timer` must be called."""
        return min((held.until for held in self._held.values()), default=_NEVER)

    # -- inside ------------------------------------------------------------------------------------------------

    def _begin(self, id: MessageId, key: str, packet: Spread, peer: str, now: float) -> _Coming | None:
        if packet.latest:
            for older, each in tuple(self._coming.items()):
                if each.key == key and each.packet.latest:
                    self.exchange.drop(older, now)
        if not self._make_room(packet.size, now):
            self._counters["flood_large_refused"] += 1
            return None
        coming = self._coming[id] = _Coming(key, packet)
        self.exchange.fetch(id, packet.size, peer, now)
        return coming

    def _newer_comes(self, key: str, packet: Spread) -> bool:
        """Return whether this latest value, or a newer one of its key, is on its way here already."""
        rank = packet.incarnation, packet.sequence
        return any(
            each.key == key and each.packet.latest and (each.packet.incarnation, each.packet.sequence) >= rank
            for each in self._coming.values()
        )

    def _make_room(self, size: int, now: float) -> bool:
        """Forget others' messages, the one first that was not asked for for longest, until there is room."""
        used = size + sum(len(held.payload) for held in self._held.values())
        used += total_of(fetch for fetch in self.exchange.fetching if fetch.id.flood)
        others = [id for id in self._held if id.origin != self._me]
        for id in sorted(others, key=lambda id: self._held[id].until):
            if used <= MAX_BYTES:
                break
            used -= len(self._held.pop(id).payload)
        return used <= MAX_BYTES

    def _was_delivered(self, id: MessageId) -> bool:
        incarnation, numbers = self._delivered.get(id.origin, (0, None))
        if numbers is None or incarnation < id.incarnation:
            numbers = deque(maxlen=MAX_DELIVERED)
            self._delivered[id.origin] = (id.incarnation, numbers)
        return incarnation <= id.incarnation and id.number in numbers


class Large:
    """Calls with `now` must not go back in time."""

    def __init__(
        self,
        me: str,
        transfers: Transfers,
        floods: LargeFloods,
        *,
        emit: Callable[[Packet], bool],
        neighbours: Callable[[], Collection[str]],
        counters: Counter[str],
    ) -> None:
        """`emit(packet)` sends one, False where there is no way."""
        self._transfers = transfers
        self._floods = floods
        self._exchange = BulkExchange(
            me, emit=emit, has=self._has, finished=self._finished, others=neighbours, counters=counters
        )
        transfers.exchange = floods.exchange = self._exchange

    def receive(self, packet: Packet, now: float) -> None:
        """Take a packet for this robot. Raises `FrameError`."""
        if packet.kind in (pieces.OFFER, pieces.STATE):
            self._transfers.receive(packet, now)
            return
        want = self._exchange.receive(packet, now)
        if want is not None and packet.id.flood:
            self._floods.wanted(packet.id, packet.sender, want.have, now)
        elif want is not None:
            self._transfers.wanted(packet.sender, packet.id, want.have, now)

    def ways_changed(self, now: float) -> None:
        """Routes are others than before."""
        self._exchange.ways_changed(now)
        self._transfers.ways_changed(now)

    def handle_timer(self, now: float) -> None:
        """Do everything that is due at `now`."""
        self._exchange.handle_timer(now)
        self._transfers.handle_timer(now)

    def next_deadline(self) -> float:
        """Return the time at which `handle_timer` must be called."""
        return min(self._exchange.next_deadline(), self._transfers.next_deadline())

    def _has(self, id: MessageId, peer: str) -> bytes | None:
        return self._floods.has(id) if id.flood else self._transfers.has(id, peer)

    def _finished(self, id: MessageId, payload: bytes | None, now: float) -> None:
        (self._floods if id.flood else self._transfers).finished(id, payload, now)
