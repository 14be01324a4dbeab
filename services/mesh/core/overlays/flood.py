"""Flooding: one robot's message to the whole swarm (thesis 3.4.5), and how those who missed it catch up.

Who sees a flood for the first time delivers it and passes it on over all links but the one it came by: it crosses
each edge once or twice, 2E - (N - 1) messages in all. A confirmed one has its echo (`overlays.echo`), 2E messages; one
of which all are to know that all have it needs 4E at most (`overlays.completion`). The origin tries a second
time where links broke meanwhile. Of keys marked latest each robot keeps the newest value; neighbours compare checksums
when their link comes up and every 30 s, and hand each other what is missing.
"""

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

from services.mesh.core.actions import Emit, Transmit
from services.mesh.core.bulk import pieces
from services.mesh.core.overlays import large_messages
from services.mesh.core.overlays.completion import Completion, decode_known
from services.mesh.core.overlays.echo import FloodId, Waves
from services.mesh.core.overlays.flood_store import NEW, OLD, CatchUp, Store
from services.mesh.core.relay import is_between_neighbours
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import FLOOD
from services.mesh.core.wire.packets import Spread
from swarm.errors import FrameError
from swarm.messages.keys import parse

MAX_ATTEMPTS = 64
"""Own confirmed floods under way; more are refused."""

BEGIN_ANEW = 1.0
"""Seconds between two changes of the own incarnation. The pause doubles while another robot with this name answers each
of them with a change of its own, up to `LONGEST_PAUSE`."""

LONGEST_PAUSE = 60.0
QUIET = 180.0
"""Seconds without a change of the own incarnation after which the pause is `BEGIN_ANEW` again."""

COUNTERS = ("flood_sent", "flood_duplicates", "flood_old", "flood_retries", "flood_unkept", "wave_sent")

_NEVER = float("inf")


@dataclass(eq=False)
class Attempt:
    """An own flood whose end is awaited."""

    token: object
    key: str
    payload: bytes
    priority: int
    patience: float
    settle: float
    """Seconds that echoes may still come after all edges have spoken."""
    all_know: bool
    """Whether all are to learn that all have it, not this robot alone by an echo."""
    first: int = 0
    tries: int = 0
    deadline: float = 0.0
    robots: set[str] = field(default_factory=set)
    goal: set[str] = field(default_factory=set)
    """The robots in reach when it began."""


class FloodOverlay:
    """The flood overlay of one robot. Calls with `now` must not go back in time."""

    def __init__(
        self,
        me: str,
        incarnation: int,
        robots: frozenset[str],
        names: Sequence[str],
        *,
        emit: Emit,
        deliver: Callable[[str, str, bytes, int, int], None],
        reached: Callable[[object, frozenset[str], bool], None],
        all_have: Callable[[str, Collection[str]], None],
        towards: Callable[[str], str | None],
        expected: Callable[[], Collection[str]],
        graph: Callable[[], Mapping[str, Collection[str]]],
        random: Callable[[], float],
        counters: Counter[str],
    ) -> None:
        """`names` are all robots, sorted. `deliver(origin, key, payload, priority, incarnation)` is called for each
        flood of others; `reached(token, robots, complete)` ends each `confirm`; `all_have(key, robots)` tells of those
        of others of which all are to know. `expected()` are the robots there is a way to; `graph()` all links."""
        self._me = me
        self._robots = robots
        self._emit = emit
        self._deliver = deliver
        self._reached = reached
        self._all_have = all_have
        self._expected = expected
        self._counters = counters
        self.store = Store()
        """The floods that this robot has seen, and the values that it keeps."""
        self.incarnation = incarnation
        self._sequence = 0
        self.store.begin(me, incarnation)
        self._began_at = -_NEVER
        self._pause = BEGIN_ANEW
        self._attempts: dict[int, Attempt] = {}
        self._waves = Waves(me, self._emit_wave, towards=towards, heard=self._heard)
        self._neighbours = CatchUp(me, self.store, emit=emit, random=random, counters=counters)
        self._links = self._neighbours.links
        self._completion = Completion(
            me,
            names,
            emit=self._emit_wave,
            links=self._links,
            expected=expected,
            graph=graph,
            complete=self._complete,
        )
        self.large = large_messages.LargeFloods(
            me, self.store, self._waves, self._completion, pass_on=self._pass_on, deliver=deliver, counters=counters
        )

    # -- own floods --------------------------------------------------------------------------------------------

    def publish(self, key: str, payload: bytes, priority: int, now: float, *, latest: bool) -> bool:
        """Flood a value of an own key; with `latest` it is kept for those who come later. False where too many large
        ones are under way."""
        if len(payload) > packets.MAX_SPREAD and not self.large.has_room(len(payload)):
            self._counters["flood_large_refused"] += 1
            return False
        self._spread(key, Spread(self.incarnation, self._next(now), payload, latest=latest), priority, now)
        return True

    def confirm(
        self,
        token: object,
        key: str,
        payload: bytes,
        priority: int,
        patience: float,
        now: float,
        *,
        all_know: bool = False,
    ) -> bool:
        """Flood, and learn by `reached` whom; False where too many are under way. `patience` is how long a try of a
        small one may take, s. With `all_know` the others learn it, too."""
        settle = patience
        if len(payload) > packets.room(all_know=all_know):
            if not self.large.has_room(len(payload)):
                return False
            patience += large_messages.patience(len(payload))
        if len(self._attempts) >= MAX_ATTEMPTS:
            return False
        attempt = Attempt(token, key, payload, priority, patience, settle, all_know=all_know)
        attempt.goal.update(self._expected())
        self._try(attempt, now)
        return True

    def progress(self, token: object) -> tuple[int, int] | None:
        """Return how many bytes of an own large flood every neighbour that fetches it has, and how many the flood has;
        None where it is not under way."""
        for attempt in self._attempts.values():
            if attempt.token == token:
                id = pieces.MessageId(self._me, self.incarnation, attempt.first, flood=True)
                return self.large.progress(id), len(attempt.payload)
        return None

    def known(self, origin: str) -> int:
        """Return the newest incarnation of a robot that was heard of; 0 = none."""
        return self.store.incarnation(origin)

    # -- inputs ------------------------------------------------------------------------------------------------

    def link_up(self, peer: str, now: float) -> None:
        """Tell a new neighbour what we keep."""
        self._neighbours.link_up(peer, now)

    def unlink(self, peer: str) -> None:
        """Send nothing more to a neighbour that is gone."""
        self._neighbours.unlink(peer)
        self._completion.unlink(peer)

    def link_down(self, peer: str, now: float) -> None:
        """Tell the waves of a lost link. Call it after `unlink`, when the routes know of it, too."""
        self._waves.link_down(peer, now)

    def ways_changed(self, now: float) -> None:
        """The map is another one."""
        self._completion.ways_changed(now)

    def receive(self, peer: str, key: str, data: bytes, priority: int, now: float) -> None:
        """Take a packet of a neighbour. Raises `FrameError`."""
        if peer not in self._links:
            return
        match packets.kind_of(data):
            case packets.SPREAD | packets.ECHO | packets.KNOWN if is_between_neighbours(key):
                raise FrameError(f"a flood under {key}, which nobody hands on")
            case packets.SPREAD:
                self._on_spread(peer, key, packets.decode_spread(data), data, priority, now)
            case packets.ECHO:
                echo = packets.decode_echo(data)
                if not set(echo.robots) <= self._robots:
                    raise FrameError("ECHO with robots that are not in our configuration")
                self._waves.echo(
                    FloodId(parse(key).robot, echo.incarnation, echo.sequence), key, priority, peer, echo, now
                )
            case packets.KNOWN:
                known = decode_known(data)
                id = FloodId(parse(key).robot, known.incarnation, known.sequence)
                self._completion.heard(id, peer, known.robots, now, final=known.final)
            case packets.DIGEST:
                digest = packets.decode_digest(data)
                incarnation, _ = digest.origins.get(self._me, (0, 0))
                if incarnation > self.incarnation:
                    self._go_above(incarnation, now)
                self._neighbours.on_digest(peer, digest, now)
            case packets.SUMMARY:
                self._neighbours.on_summary(peer, packets.decode_summary(data), now)
            case kind:
                raise FrameError(f"flood packet kind {kind}: not known")

    def pushed_back(self, packet: Transmit, now: float) -> None:
        """The queue of a link had no room for one of our packets: it is sent later."""
        self._neighbours.pushed_back(packet, now)

    def handle_timer(self, now: float) -> None:
        """Do everything that is due at `now`."""
        self._waves.handle_timer(now)
        self._completion.handle_timer(now)
        self.large.handle_timer(now)
        for sequence, attempt in list(self._attempts.items()):
            if now >= attempt.deadline and self._attempts.get(sequence) is attempt:
                self._expire(sequence, attempt, now)
        self._neighbours.handle_timer(now)
        self._counters["flood_unkept"] = self.store.unkept

    def next_deadline(self) -> float:
        """Return the time at which `handle_timer` must be called."""
        deadline = min((attempt.deadline for attempt in self._attempts.values()), default=_NEVER)
        return min(deadline, self.large.next_deadline(), self._neighbours.next_deadline())

    # -- spreading ---------------------------------------------------------------------------------------------

    def _next(self, now: float) -> int:
        if self._sequence == packets.MAX_SEQUENCE:
            self._begin(self.incarnation + 1, now)
        self._sequence += 1
        return self._sequence

    def _spread(self, key: str, packet: Spread, priority: int, now: float) -> None:
        """Begin an own flood: note it as seen, and send it."""
        self.store.take(self._me, key, packet, priority)
        if len(packet.payload) > packets.room(all_know=bool(packet.known)):
            id = pieces.MessageId(self._me, packet.incarnation, packet.first or packet.sequence, flood=True)
            self.large.hold(id, packet.payload, now, key if packet.latest else "")
            packet = packet._replace(payload=b"", size=len(packet.payload))
        self._pass_on(key, packet, priority, None)

    def _pass_on(
        self, key: str, packet: Spread, priority: int, source: str | None, data: bytes | None = None
    ) -> list[str]:
        """Send a flood on as it is; `data` is the packet's bytes, where they are there."""
        data = packets.encode_spread(packet) if data is None else data
        others = [peer for peer in self._links if peer != source]
        for peer in others:
            self._counters["flood_sent"] += 1
            self._counters["wave_sent"] += packet.echo or packet.known > 0
            self._neighbours.spread(Transmit(peer, FLOOD, key, data, priority, packet.latest))
        return others

    def _on_spread(self, peer: str, key: str, packet: Spread, data: bytes, priority: int, now: float) -> None:
        origin = parse(key).robot
        if origin == self._me:
            self._on_own(peer, key, packet, priority, now)
            return
        verdict = self.store.take(origin, key, packet, priority)
        if verdict == OLD:
            self._counters["flood_old"] += 1
            if origin == peer:
                # All its floods are dropped here until it chooses a higher incarnation.
                self._neighbours.on_old(peer, now)
            return
        if packet.size:
            self.large.announced(peer, origin, key, packet, verdict, now)
            return
        id = FloodId(origin, packet.incarnation, packet.sequence)
        first = id._replace(sequence=packet.first or packet.sequence)
        if verdict != NEW:
            self._counters["flood_duplicates"] += 1
            if packet.echo:
                self._waves.again(id, key, priority, peer, now)
            elif packet.known:
                self._completion.heard(first, peer, packet.known, now)
            return
        if packet.known:
            known = self._completion.reached(first, key, priority, peer, packet.known, now, has=True)
            data = packets.encode_spread(packet._replace(known=known))
        others = self._pass_on(key, packet, priority, peer, data)
        if packet.echo:
            self._waves.join(id, key, priority, peer, others, now)
        if not packet.first or not self.store.has_seen(origin, packet.first):
            self._deliver(origin, key, packet.payload, priority, packet.incarnation)
        if packet.known:
            self._completion.spread(first, others, now)

    def _on_own(self, peer: str, key: str, packet: Spread, priority: int, now: float) -> None:
        """Our own flood came round; or one of an earlier life of ours, or of a member that pretends to be us."""
        if (packet.incarnation, packet.sequence) > (self.incarnation, self._sequence):
            self._go_above(packet.incarnation, now)
        elif packet.echo and packet.incarnation == self.incarnation:
            self._waves.again(FloodId(self._me, packet.incarnation, packet.sequence), key, priority, peer, now)
        elif packet.known:
            first = FloodId(self._me, packet.incarnation, packet.first or packet.sequence)
            self._completion.heard(first, peer, packet.known, now)

    def _go_above(self, incarnation: int, now: float) -> None:
        """Others know us by a higher incarnation: without this they would take all we say for old."""
        if now >= self._began_at + self._pause and incarnation < packets.MAX_INCARNATION:
            quiet = now >= self._began_at + QUIET
            self._pause = BEGIN_ANEW if quiet else min(LONGEST_PAUSE, 2.0 * self._pause)
            self._began_at = now
            self._begin(incarnation + 1, now)

    def _begin(self, incarnation: int, now: float) -> None:
        kept = self.store.kept(self._me)
        self.incarnation, self._sequence = incarnation, 0
        self.store.begin(self._me, incarnation)
        for key, value in kept:
            packet = Spread(incarnation, self._next(now), value.payload, latest=True)
            self._spread(key, packet, value.priority, now)
        # Tried again at the next timer; until then under numbers that no sequence can have.
        attempts = set(self._attempts.values())
        self._attempts = {-1 - place: attempt for place, attempt in enumerate(attempts)}
        for attempt in attempts:
            attempt.tries, attempt.first, attempt.deadline = 0, 0, 0.0

    # -- the end at the origin ---------------------------------------------------------------------------------

    def _try(self, attempt: Attempt, now: float) -> None:
        sequence = self._next(now)
        attempt.tries += 1
        attempt.deadline = now + attempt.patience
        self._attempts[sequence] = attempt
        packet = Spread(self.incarnation, sequence, attempt.payload, echo=not attempt.all_know, first=attempt.first)
        attempt.first = attempt.first or sequence
        life = large_messages.patience(len(attempt.payload))
        if attempt.all_know:
            first = FloodId(self._me, self.incarnation, attempt.first)
            known = self._completion.reached(first, attempt.key, attempt.priority, "", 0, now, has=True, life=life)
            self._spread(attempt.key, packet._replace(known=known), attempt.priority, now)
            self._completion.spread(first, self._links, now)
            return
        self._spread(attempt.key, packet, attempt.priority, now)
        id = FloodId(self._me, self.incarnation, sequence)
        self._waves.begin(id, attempt.key, attempt.priority, self._links, now, life)

    def _complete(self, id: FloodId, key: str, now: float) -> None:
        """Note that all have a flood of which all are to know."""
        if id.origin != self._me:
            self._all_have(key, self._completion.robots(id))
            return
        for attempt in set(self._attempts.values()):
            if attempt.all_know and attempt.first == id.sequence and id.incarnation == self.incarnation:
                self._end(attempt, complete=True)

    def _heard(self, id: FloodId, robots: Collection[str], lost: bool, over: bool, now: float) -> None:
        attempt = self._attempts.get(id.sequence)
        if attempt is None or id.incarnation != self.incarnation:
            return
        attempt.robots.update(robots)
        # Where a link broke, those behind it may be back in a moment: that is what the second try is for.
        if over and (not lost or attempt.robots.issuperset(attempt.goal.union(self._expected()))):
            self._end(attempt, complete=True)
        elif over:
            attempt.deadline = min(attempt.deadline, now + attempt.settle)

    def _expire(self, sequence: int, attempt: Attempt, now: float) -> None:
        if attempt.all_know:
            attempt.robots.update(self._completion.robots(FloodId(self._me, self.incarnation, attempt.first)))
        if attempt.robots.issuperset(self._expected()):
            self._end(attempt, complete=True)
            if attempt.all_know:
                self._completion.end(FloodId(self._me, self.incarnation, attempt.first), now)
        elif attempt.tries >= 2:
            self._end(attempt, complete=False)
        else:
            # The first try stays known: a late echo of an orphan still counts.
            self._counters["flood_retries"] += 1
            self._try(attempt, now)

    def _end(self, attempt: Attempt, *, complete: bool) -> None:
        for sequence in [sequence for sequence, each in self._attempts.items() if each is attempt]:
            del self._attempts[sequence]
            self._waves.forget(FloodId(self._me, self.incarnation, sequence))
        if attempt.all_know:
            attempt.robots.update(self._completion.robots(FloodId(self._me, self.incarnation, attempt.first)))
        self._reached(attempt.token, frozenset(attempt.robots - {self._me}), complete)

    # -- inside ------------------------------------------------------------------------------------------------

    def _emit_wave(self, packet: Transmit) -> None:
        self._counters["wave_sent"] += 1
        self._emit(packet)
