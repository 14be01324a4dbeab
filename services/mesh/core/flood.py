"""Flooding: one robot's message to the whole swarm (thesis 3.4.5), and how those who missed it catch up.

Who sees a flood for the first time delivers it and passes it on over all links but the one it came by: it crosses
each edge once or twice, 2E - (N - 1) messages in all. A confirmed one has its echo (`core.echo`), 2E messages; the
origin tries a second time where links broke meanwhile. Of keys marked latest each robot keeps the newest value;
neighbours compare checksums when their link comes up and every 30 s, and hand each other what is missing.
"""

from collections import Counter
from collections.abc import Callable, Collection

from services.mesh.core import packets
from services.mesh.core.actions import Emit, Transmit
from services.mesh.core.echo import Id, Waves
from services.mesh.core.frames import BULK, FLOOD
from services.mesh.core.packets import Spread
from services.mesh.core.store import NEW, OLD, Store
from swarm.errors import FrameError
from swarm.keys import key as key_of
from swarm.keys import parse

COMPARE_PERIOD = 30.0
"""s between two comparisons of what two neighbours keep, each spread by a fifth. Repairs what full queues dropped."""

ANSWER_PERIOD = 2.0
"""s between two whole digests to one neighbour, the one at link-up aside."""

REPAIR_PERIOD = 0.1
REPAIR_BYTES = 4096
"""Missing values leave in portions, 41 kB/s: half of what a Bluetooth link carries, in the class of each value."""

MAX_ATTEMPTS = 64
"""Own confirmed floods under way; more are refused."""

BEGIN_ANEW = 1.0
"""s between two changes of the own incarnation."""

COUNTERS = ("flood_sent", "flood_duplicates", "flood_old", "flood_retries", "flood_unkept", "repaired", "wave_sent")

_NEVER = float("inf")


class Attempt:
    """An own flood whose echo is awaited."""

    __slots__ = ("deadline", "first", "goal", "key", "patience", "payload", "priority", "robots", "token", "tries")

    def __init__(self, token: object, key: str, payload: bytes, priority: int, patience: float) -> None:
        self.token = token
        self.key = key
        self.payload = payload
        self.priority = priority
        self.patience = patience
        self.first = 0
        self.tries = 0
        self.deadline = 0.0
        self.robots: set[str] = set()
        self.goal: set[str] = set()
        """Who could be reached when it began."""


class Neighbour:
    """What is under way to one neighbour."""

    __slots__ = ("answered_at", "compare_at", "missing", "repair_at")

    def __init__(self, compare_at: float) -> None:
        self.compare_at = compare_at
        self.answered_at = -_NEVER
        self.missing: dict[tuple[str, str], None] = {}
        """Values to be sent, by origin and key."""
        self.repair_at = _NEVER


class Flood:
    """The flood overlay of one robot. Calls with `now` must not go back in time."""

    def __init__(
        self,
        me: str,
        incarnation: int,
        robots: frozenset[str],
        *,
        emit: Emit,
        deliver: Callable[[str, str, bytes, int, int], None],
        reached: Callable[[object, frozenset[str], bool], None],
        towards: Callable[[str], str | None],
        expected: Callable[[], Collection[str]],
        random: Callable[[], float],
        counters: Counter[str],
    ) -> None:
        """`deliver(origin, key, payload, priority, incarnation)` is called for each flood of others;
        `reached(token, robots, complete)` ends each `confirm`; `expected()` are the robots there is a way to."""
        self._me = me
        self._robots = robots
        self._emit = emit
        self._deliver = deliver
        self._reached = reached
        self._expected = expected
        self._random = random
        self._counters = counters
        self._store = Store()
        self.incarnation = incarnation
        self._sequence = 0
        self._store.begin(me, incarnation)
        self._began_at = -_NEVER
        self._links: dict[str, Neighbour] = {}
        self._attempts: dict[int, Attempt] = {}
        self._waves = Waves(me, self._emit_wave, towards=towards, heard=self._heard)
        self._digest_key = key_of(me, "mesh", "digest")

    # -- own floods --------------------------------------------------------------------------------------------

    def publish(self, key: str, payload: bytes, priority: int, *, latest: bool) -> None:
        """Flood a value of an own key; with `latest` it is kept for those who come later."""
        self._spread(key, Spread(self.incarnation, self._next(), payload, latest=latest), priority)

    def confirm(self, token: object, key: str, payload: bytes, priority: int, patience: float, now: float) -> bool:
        """Flood, and learn by `reached` whom; False where too many are under way. `patience` is how long a try may
        take, s."""
        if len(self._attempts) >= MAX_ATTEMPTS:
            return False
        attempt = Attempt(token, key, payload, priority, patience)
        attempt.goal.update(self._expected())
        self._try(attempt, now)
        return True

    def forget(self, origin: str) -> None:
        """A robot has been gone for long: its values are not handed on any more."""
        self._store.forget(origin)

    def known(self, origin: str) -> int:
        """The newest incarnation of a robot that was heard of; 0 = none."""
        return self._store.incarnation(origin)

    # -- inputs ------------------------------------------------------------------------------------------------

    def link_up(self, peer: str, now: float) -> None:
        """Tell a new neighbour what we keep."""
        self._links[peer] = Neighbour(now + self._compare_period())
        self._send_digest(peer, answer=False)

    def unlink(self, peer: str) -> None:
        """A neighbour is gone: nothing goes to it any more."""
        self._links.pop(peer, None)

    def link_down(self, peer: str, now: float) -> None:
        """After `unlink`, when routes know it, too: what echoes make of it."""
        self._waves.link_down(peer, now)

    def receive(self, peer: str, key: str, data: bytes, priority: int, now: float) -> None:
        """A packet of a neighbour; raises `FrameError`."""
        if peer not in self._links:
            return
        match packets.kind_of(data):
            case packets.SPREAD:
                self._on_spread(peer, key, packets.decode_spread(data), data, priority, now)
            case packets.ECHO:
                echo = packets.decode_echo(data)
                if not set(echo.robots) <= self._robots:
                    raise FrameError("ECHO with robots that are not in our configuration")
                self._waves.echo(Id(parse(key).robot, echo.incarnation, echo.sequence), key, priority, peer, echo, now)
            case packets.DIGEST:
                self._on_digest(peer, packets.decode_digest(data), now)
            case packets.SUMMARY:
                if packets.decode_summary(data) != self._store.summary():
                    self._answer(peer, now, answer=True)
            case kind:
                raise FrameError(f"flood packet kind {kind}: not known")

    def handle_timer(self, now: float) -> None:
        """Whatever is due."""
        self._waves.handle_timer(now)
        for sequence, attempt in list(self._attempts.items()):
            if now >= attempt.deadline and self._attempts.get(sequence) is attempt:
                self._expire(sequence, attempt, now)
        for peer, link in self._links.items():
            if now >= link.repair_at:
                self._repair(peer, link, now)
            if now >= link.compare_at:
                link.compare_at = now + self._compare_period()
                self._transmit(peer, self._digest_key, packets.encode_summary(self._store.summary()), BULK)
        self._counters["flood_unkept"] = self._store.unkept

    def next_deadline(self) -> float:
        """When `handle_timer` wants to be called."""
        deadline = _NEVER
        for attempt in self._attempts.values():
            deadline = min(deadline, attempt.deadline)
        for link in self._links.values():
            deadline = min(deadline, link.repair_at, link.compare_at)
        return deadline

    # -- spreading ---------------------------------------------------------------------------------------------

    def _next(self) -> int:
        if self._sequence == packets.MAX_SEQUENCE:
            self._begin(self.incarnation + 1)
        self._sequence += 1
        return self._sequence

    def _spread(self, key: str, packet: Spread, priority: int) -> None:
        """An own flood: noted as seen, and off."""
        self._store.take(self._me, key, packet, priority)
        self._pass_on(key, packet, packets.encode_spread(packet), priority, None)

    def _pass_on(self, key: str, packet: Spread, data: bytes, priority: int, source: str | None) -> None:
        """Send a flood on as it is; `data` is the packet's bytes."""
        for peer in self._links:
            if peer != source:
                self._counters["flood_sent"] += 1
                self._counters["wave_sent"] += packet.echo
                self._emit(Transmit(peer, FLOOD, key, data, priority, packet.latest))

    def _on_spread(self, peer: str, key: str, packet: Spread, data: bytes, priority: int, now: float) -> None:
        origin = parse(key).robot
        if origin == self._me:
            self._on_own(peer, key, packet, priority, now)
            return
        verdict = self._store.take(origin, key, packet, priority)
        if verdict == OLD:
            self._counters["flood_old"] += 1
            return
        id = Id(origin, packet.incarnation, packet.sequence)
        if verdict != NEW:
            self._counters["flood_duplicates"] += 1
            if packet.echo:
                self._waves.again(id, key, priority, peer, now)
            return
        if packet.echo:
            others = [each for each in self._links if each != peer]
            self._pass_on(key, packet, data, priority, peer)
            self._waves.join(id, key, priority, peer, others, now)
        else:
            self._pass_on(key, packet, data, priority, peer)
        if not packet.first or not self._store.has_seen(origin, packet.first):
            self._deliver(origin, key, packet.payload, priority, packet.incarnation)

    def _on_own(self, peer: str, key: str, packet: Spread, priority: int, now: float) -> None:
        """Our own flood came round; or one of an earlier life of ours, or of a member that pretends to be us."""
        if (packet.incarnation, packet.sequence) > (self.incarnation, self._sequence):
            self._go_above(packet.incarnation, now)
        elif packet.echo and packet.incarnation == self.incarnation:
            self._waves.again(Id(self._me, packet.incarnation, packet.sequence), key, priority, peer, now)

    def _go_above(self, incarnation: int, now: float) -> None:
        """Others know us by a higher incarnation: without this they would take all we say for old."""
        if now >= self._began_at + BEGIN_ANEW and incarnation < packets.MAX_INCARNATION:
            self._began_at = now
            self._begin(incarnation + 1)

    def _begin(self, incarnation: int) -> None:
        kept = self._store.kept(self._me)
        self.incarnation, self._sequence = incarnation, 0
        self._store.begin(self._me, incarnation)
        for key, value in kept:
            self.publish(key, value.payload, value.priority, latest=True)
        # Tried again at the next timer; until then under numbers that no sequence can have.
        attempts = set(self._attempts.values())
        self._attempts = {-1 - place: attempt for place, attempt in enumerate(attempts)}
        for attempt in attempts:
            attempt.tries, attempt.first, attempt.deadline = 0, 0, 0.0

    # -- the echo at the origin --------------------------------------------------------------------------------

    def _try(self, attempt: Attempt, now: float) -> None:
        sequence = self._next()
        attempt.tries += 1
        attempt.deadline = now + attempt.patience
        self._attempts[sequence] = attempt
        packet = Spread(self.incarnation, sequence, attempt.payload, echo=True, first=attempt.first)
        attempt.first = attempt.first or sequence
        self._spread(attempt.key, packet, attempt.priority)
        id = Id(self._me, self.incarnation, sequence)
        self._waves.begin(id, attempt.key, attempt.priority, self._links, now)

    def _heard(self, id: Id, robots: Collection[str], lost: bool, over: bool) -> None:
        attempt = self._attempts.get(id.sequence)
        if attempt is None or id.incarnation != self.incarnation:
            return
        attempt.robots.update(robots)
        # Where a link broke, those behind it may be back in a moment: that is what the second try is for.
        if over and (not lost or attempt.robots.issuperset(attempt.goal.union(self._expected()))):
            self._end(attempt, complete=True)

    def _expire(self, sequence: int, attempt: Attempt, now: float) -> None:
        if attempt.robots.issuperset(self._expected()):
            self._end(attempt, complete=True)
        elif attempt.tries >= 2:
            self._end(attempt, complete=False)
        else:
            # The first try stays known: a late echo of an orphan still counts.
            self._counters["flood_retries"] += 1
            self._try(attempt, now)

    def _end(self, attempt: Attempt, *, complete: bool) -> None:
        for sequence in [sequence for sequence, each in self._attempts.items() if each is attempt]:
            del self._attempts[sequence]
            self._waves.forget(Id(self._me, self.incarnation, sequence))
        self._reached(attempt.token, frozenset(attempt.robots - {self._me}), complete)

    # -- repair ------------------------------------------------------------------------------------------------

    def _compare_period(self) -> float:
        return COMPARE_PERIOD * (0.8 + 0.4 * self._random())

    def _send_digest(self, peer: str, *, answer: bool) -> None:
        for data in packets.encode_digests(self._store.digest(), answer=answer):
            self._transmit(peer, self._digest_key, data, BULK)

    def _answer(self, peer: str, now: float, *, answer: bool) -> None:
        link = self._links[peer]
        if now >= link.answered_at + ANSWER_PERIOD:
            link.answered_at = now
            self._send_digest(peer, answer=answer)

    def _on_digest(self, peer: str, digest: packets.Digest, now: float) -> None:
        incarnation, _ = digest.origins.get(self._me, (0, 0))
        if incarnation > self.incarnation:
            self._go_above(incarnation, now)
        theirs, _ = digest.origins.get(peer, (0, 0))
        if theirs > self._store.incarnation(peer):
            self._store.begin(peer, theirs)  # it has begun anew: nobody else can know that better
        link, differs = self._links[peer], False
        for origin in self._store.lacking(digest.low, digest.high, digest.origins):
            differs = True
            if digest.origins.get(origin, (0, 0))[0] <= self._store.incarnation(origin):
                link.missing |= {(origin, key): None for key, _ in self._store.kept(origin)}
        if link.missing and link.repair_at == _NEVER:
            self._repair(peer, link, now)
        if digest.answer and (differs or digest.origins.keys() - self._store.digest().keys()):
            self._answer(peer, now, answer=False)

    def _repair(self, peer: str, link: Neighbour, now: float) -> None:
        size = 0
        while link.missing and size < REPAIR_BYTES:
            origin, key = next(iter(link.missing))
            del link.missing[origin, key]
            kept = self._store.one(origin, key)
            if kept is not None:
                packet = Spread(self._store.incarnation(origin), kept.sequence, kept.payload, latest=True)
                data = packets.encode_spread(packet)
                size += len(data)
                self._counters["repaired"] += 1
                self._emit(Transmit(peer, FLOOD, key, data, kept.priority, latest=True))
        link.repair_at = now + REPAIR_PERIOD if link.missing else _NEVER

    def _transmit(self, peer: str, key: str, data: bytes, priority: int) -> None:
        self._emit(Transmit(peer, FLOOD, key, data, priority))

    def _emit_wave(self, packet: Transmit) -> None:
        self._counters["wave_sent"] += 1
        self._emit(packet)
