"""Large messages between any two robots: who needs one fetches it piece by piece, who has it answers.

The receiver asks, so it decides how much it takes in, and asks again for what was lost; who answers keeps nothing but
the message. A robot that is still fetching a flood's message hands its pieces on as they come: one that asks for a
piece which is not there yet gets it when it is.

**Repair.** Pieces mostly come in the order in which they were asked for. So a piece is lost if others come that were
asked for later. If no piece comes for a while, or ways change, the awaited pieces are either late in a long queue or
lost. Then the robot asks for one piece more. If that piece comes first, the others are lost. If the others come first,
nothing was asked for twice.

**Turns.** The messages of one robot take turns, so that a long one does not hold up the others. A message of which no
piece comes while those of others do is stalled: its sender itself waits for it, or is gone. Until a piece of it comes,
only one is asked for at a time.
"""

from collections import deque
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field

from services.mesh.core.bulk import pieces
from services.mesh.core.bulk.pieces import ASKED, GONE, PIECE, SIZE, WANT, Fetch, MessageId, Packet

PATIENCE = 30.0
"""Seconds without a new piece after which a message is given up."""

TIMEOUT = 2.0
"""Seconds without a piece of a message after which one more is asked for. Each timeout in a row doubles them."""

MOST_TIMEOUT = 8.0
"""Seconds up to which they are doubled."""

TRIED = 2
"""Timeouts in a row after which another robot is asked, where one may have the message."""

LOOK_AGAIN = 2.0
"""Seconds until neighbours are tried where nobody is left to be asked."""

MOST_PROBES = 4
"""Pieces of one robot beyond `ASKED` that may be under way because ways have changed."""

MAX_WAITING = 4 * pieces.MAX_WANTED
"""Pieces that are remembered to be handed on to one robot when they come."""

COUNTERS = ("pieces_sent", "pieces_repeated", "pieces_useless", "large_incomplete")

_NEVER = float("inf")


@dataclass(eq=False)
class _Source:
    """A robot that we fetch from."""

    fetches: dict[MessageId, Fetch] = field(default_factory=dict)
    timeouts: int = 0
    """Timeouts since the last piece came."""

    @property
    def asked(self) -> int:
        """Return the number of pieces asked for."""
        return sum(fetch.asked for fetch in self.fetches.values())

    @property
    def timeout(self) -> float:
        """Seconds without a piece of a message after which the message is overdue."""
        return min(MOST_TIMEOUT, TIMEOUT * 2.0 ** min(self.timeouts, 8))

    @property
    def deadline(self) -> float:
        """Return the time at which one of its messages is overdue."""
        return min((fetch.waiting_since for fetch in self.fetches.values()), default=_NEVER) + self.timeout


class BulkExchange:
    """All large messages of one robot. Calls with `now` must not go back in time."""

    def __init__(
        self,
        me: str,
        *,
        emit: Callable[[Packet], bool],
        has: Callable[[MessageId, str], bytes | None],
        finished: Callable[[MessageId, bytes | None, float], None],
        others: Callable[[], Collection[str]],
        counters: dict[str, int],
    ) -> None:
        """`emit(packet)` sends one, False where there is no way; `has(id, peer)` is a whole message that `peer` may
        ask for; `finished(id, payload, now)` ends each fetch, without a payload where it was given up; `others()` may
        have a flood's message when nobody else has it."""
        self._me = me
        self._emit = emit
        self._has = has
        self._finished = finished
        self._others = others
        self._counters = counters
        self._sources: dict[str, _Source] = {}
        self._fetches: dict[MessageId, Fetch] = {}
        self._waiting: dict[MessageId, dict[str, dict[int, None]]] = {}
        """Pieces of unfinished messages that others wait for."""
        self._look_at = _NEVER
        self._to_ask: dict[str, None] = {}
        """Robots that are to be asked for pieces, in this order."""
        self._asking = False

    # -- what this robot fetches -------------------------------------------------------------------------------

    @property
    def fetching(self) -> Collection[Fetch]:
        """Messages on their way here."""
        return self._fetches.values()

    def fetch(self, id: MessageId, total: int, source: str, now: float) -> None:
        """Fetch a message that `source` has, or will have."""
        fetch = self._fetches[id] = Fetch(id, total, now)
        self._assign(fetch, source, now)

    def add_source(self, id: MessageId, robot: str, now: float) -> None:
        """Note that `robot` may have the message, too."""
        fetch = self._fetches.get(id)
        if fetch is not None and robot != fetch.source and robot not in fetch.sources:
            fetch.sources.append(robot)
            if fetch.source is None:
                self._next_source(fetch, now)

    def drop(self, id: MessageId, now: float) -> None:
        """Give a message up."""
        if (fetch := self._fetches.pop(id, None)) is not None:
            source = fetch.source
            self._leave(fetch)
            for peer in self._waiting.pop(id, ()):
                self._emit(Packet(GONE, self._me, peer, id, b""))
            self._counters["large_incomplete"] += 1
            self._finished(id, None, now)
            self._ask(source, now)

    def ways_changed(self, now: float) -> None:
        """Look for another source of each fetch that has none, since routes have changed."""
        for fetch in tuple(self._fetches.values()):
            if fetch.source is None:
                self._next_source(fetch, now)
        for name in tuple(self._sources):
            source = self._sources.get(name)
            if source is not None:
                for fetch in tuple(source.fetches.values()):
                    # Without a further piece a probe asks for one twice. So it is made only after a silence.
                    worth = fetch.has_further or source.timeouts
                    if worth and fetch.source == name and source.asked < ASKED + MOST_PROBES:
                        self._probe(name, fetch, now)
            self._ask(name, now)

    # -- packets -----------------------------------------------------------------------------------------------

    def receive(self, packet: Packet, now: float) -> pieces.WantBody | None:
        """Take a WANT (which is returned), PIECE or GONE for this robot. Raises `FrameError`."""
        if packet.kind == WANT:
            want = pieces.decode_want(packet.body)
            self._on_want(packet.sender, packet.id, want)
            return want
        if packet.kind == PIECE:
            self._on_piece(packet.sender, packet.id, *pieces.decode_piece(packet.body), now)
        else:
            self._on_gone(packet.sender, packet.id, now)
        return None

    def _on_piece(self, sender: str, id: MessageId, index: int, data: bytes, now: float) -> None:
        fetch = self._fetches.get(id)
        before = fetch.repeated if fetch is not None else 0
        if fetch is None or not fetch.take(index, data, now):
            self._counters["pieces_useless"] += 1
            return
        self._counters["pieces_repeated"] += fetch.repeated - before
        if (source := self._sources.get(sender)) is not None:
            source.timeouts = 0
        for peer, indexes in self._waiting.get(id, {}).items():
            if index in indexes:
                del indexes[index]
                self._give(peer, id, index, data)
        asked = fetch.source
        if fetch.complete:
            del self._fetches[id]
            self._leave(fetch)
            self._waiting.pop(id, None)
            self._finished(id, fetch.payload(), now)
        self._ask(sender, now)
        self._ask(asked, now)  # this may be another robot: the piece may be late, of one that was asked before

    def _on_gone(self, sender: str, id: MessageId, now: float) -> None:
        fetch = self._fetches.get(id)
        if fetch is None or sender != fetch.source:
            return
        if id.flood:
            self._next_source(fetch, now)
        else:
            self.drop(id, now)

    def _on_want(self, peer: str, id: MessageId, want: pieces.WantBody) -> None:
        payload = self._has(id, peer)
        if payload is not None:
            count = pieces.count_of(len(payload))
            for index in want.indexes:
                if index < count:
                    self._give(peer, id, index, payload[index * SIZE : (index + 1) * SIZE])
            return
        fetch = self._fetches.get(id)
        if fetch is None or not id.flood:
            self._emit(Packet(GONE, self._me, peer, id, b""))
            return
        waiting = self._waiting.setdefault(id, {}).setdefault(peer, {})
        for index in want.indexes:
            data = fetch.piece(index)
            if data is not None:
                self._give(peer, id, index, data)
            elif index < fetch.count and len(waiting) < MAX_WAITING:
                waiting[index] = None

    def _give(self, peer: str, id: MessageId, index: int, data: bytes) -> None:
        self._counters["pieces_sent"] += 1
        self._emit(Packet(PIECE, self._me, peer, id, pieces.encode_piece(index, data)))

    # -- time --------------------------------------------------------------------------------------------------

    def handle_timer(self, now: float) -> None:
        """Ask again, or somebody else, or give up."""
        for fetch in tuple(self._fetches.values()):
            if now >= fetch.heard + PATIENCE:
                self.drop(fetch.id, now)
        for name in tuple(self._sources):
            source = self._sources.get(name)
            if source is not None and now >= source.deadline:
                self._on_timeout(name, source, now)
        if now >= self._look_at:
            self._look_at = _NEVER
            for fetch in self._fetches.values():
                if fetch.source is None:
                    fetch.sources.extend(name for name in self._others() if name not in fetch.sources)
                    self._next_source(fetch, now)

    def _on_timeout(self, name: str, source: _Source, now: float) -> None:
        overdue = [fetch for fetch in source.fetches.values() if now >= fetch.waiting_since + source.timeout]
        source.timeouts += 1
        for fetch in overdue:
            if fetch.source != name:
                continue  # another robot is asked meanwhile
            others_come = any(each.have and each.heard > fetch.waiting_since for each in source.fetches.values())
            if fetch.sources and (others_come or source.timeouts >= TRIED):
                fetch.sources.append(name)
                self._next_source(fetch, now)
            elif others_come:
                fetch.ask_again()
                fetch.stalled = True
                self._ask_for_one(name, fetch, fetch.pick(now), now)
                self._ask(name, now)  # the other messages get its places
            else:
                self._probe(name, fetch, now)
        for fetch in tuple(source.fetches.values()):
            if not fetch.asked and fetch.source == name:
                # All places belong to messages of which no piece comes: one more piece is asked for.
                self._ask_for_one(name, fetch, fetch.pick(now), now)

    def next_deadline(self) -> float:
        """Return the time at which `handle_timer` must be called."""
        deadline = self._look_at
        for source in self._sources.values():
            deadline = min(deadline, source.deadline)
        for fetch in self._fetches.values():
            deadline = min(deadline, fetch.heard + PATIENCE)
        return deadline

    # -- inside ------------------------------------------------------------------------------------------------

    def _probe(self, name: str, fetch: Fetch, now: float) -> None:
        before, index = fetch.repeated, fetch.probe(now)
        self._counters["pieces_repeated"] += fetch.repeated - before
        self._ask_for_one(name, fetch, index, now)

    def _ask_for_one(self, name: str, fetch: Fetch, index: int | None, now: float) -> None:
        """Ask a robot for a piece that was chosen; for none where it is None."""
        if index is not None:
            self._want(name, fetch, [index], now)

    def _assign(self, fetch: Fetch, robot: str, now: float) -> None:
        fetch.source = robot
        self._sources.setdefault(robot, _Source()).fetches[fetch.id] = fetch
        self._ask(robot, now)

    def _leave(self, fetch: Fetch) -> None:
        """The robot that was asked so far is not asked any more."""
        if (name := fetch.source) is not None:
            source = self._sources[name]
            del source.fetches[fetch.id]
            fetch.source = None
            if not source.fetches:
                del self._sources[name]

    def _next_source(self, fetch: Fetch, now: float) -> None:
        fetch.ask_again()
        fetch.stalled = False
        before = fetch.source
        self._leave(fetch)
        if fetch.sources:
            self._assign(fetch, fetch.sources.popleft(), now)
        else:
            self._look_at = min(self._look_at, now + LOOK_AGAIN)
        self._ask(before, now)

    def _ask(self, name: str | None, now: float) -> None:
        """Ask a robot for as many pieces as may be under way. A call that comes of another one is made after it."""
        if name is not None:
            self._to_ask[name] = None
        if self._asking:
            return
        self._asking = True
        while self._to_ask:
            name = next(iter(self._to_ask))
            del self._to_ask[name]
            self._fill_up(name, now)
        self._asking = False

    def _fill_up(self, name: str, now: float) -> None:
        """Ask a robot for as many pieces as may be under way, its messages in turns."""
        source = self._sources.get(name)
        if source is None:
            return  # nothing is fetched from it any more
        room = ASKED - source.asked
        if room < 2 and source.asked:
            return  # a WANT for two pieces at least
        waiting = deque(fetch for fetch in source.fetches.values() if not fetch.stalled)
        picked: dict[MessageId, list[int]] = {}
        while room > 0 and waiting:
            fetch = waiting.popleft()
            index = fetch.pick(now)
            if index is not None:
                picked.setdefault(fetch.id, []).append(index)
                room -= 1
                waiting.append(fetch)
                source.fetches[fetch.id] = source.fetches.pop(fetch.id)  # its turn has been
        for id, indexes in picked.items():
            self._want(name, source.fetches[id], indexes, now)

    def _want(self, name: str, fetch: Fetch, indexes: list[int], now: float) -> None:
        for at in range(0, len(indexes), pieces.MAX_RANGES):
            body = pieces.encode_want(fetch.have, indexes[at : at + pieces.MAX_RANGES])
            if not self._emit(Packet(WANT, self._me, name, fetch.id, body)):
                fetch.ask_again()
                if fetch.id.flood:
                    self._next_source(fetch, now)
                break  # else `ways_changed` comes when there is a way


def total_of(fetches: Iterable[Fetch]) -> int:
    """Return the number of bytes that these messages have, or will have."""
    return sum(fetch.total for fetch in fetches)
