"""The echo of a flood (propagation of information with feedback; Chang 1982): whom it reached, and that it is over.

    origin ---SPREAD---> a ---SPREAD---> b        parent = who brought the first copy
           <---ECHO----    <---ECHO----           a robot answers its parent when every other edge has spoken

Each edge carries exactly one message each way, 2E in all: on an edge of the tree SPREAD down and ECHO up, on any
other edge a SPREAD each way, which each end takes for the other's answer.

Links that break meanwhile:
- an edge that owes us its answer: it is taken for an empty one and the echo is marked `lost`;
- the edge to the parent: this robot is an orphan; its echo goes by another link towards the origin, marked, and
  whoever gets it adds it to the own echo or, where that has left already, passes it on.
"""

from collections import OrderedDict
from collections.abc import Callable, Collection
from typing import NamedTuple

from services.mesh.core.actions import Emit, Transmit
from services.mesh.core.wire.frames import FLOOD
from services.mesh.core.wire.packets import EchoPacket, encode_echo

MAX_WAVES = 256
"""Confirmed floods a robot remembers its part in; past that the oldest is forgotten, and its origin tries again."""

LIFE = 30.0
"""Seconds after which a wave is forgotten, whatever became of it."""

RECENT = 5.0
"""s: an echo that left so recently may have died with the link it went over (silence is noticed after 3 s)."""

ORPHAN_TTL = 32


class FloodId(NamedTuple):
    """Names one flood in the whole swarm."""

    origin: str
    incarnation: int
    sequence: int


class Wave:
    """This robot's part in one confirmed flood."""

    def __init__(
        self, key: str, priority: int, parent: str | None, pending: set[str], robots: Collection[str], ends: float
    ) -> None:
        self.key = key
        self.priority = priority
        self.parent = parent
        """None at the origin."""
        self.pending = pending
        """Neighbours that owe their message."""
        self.spoken = set(pending)
        """Neighbours that have had ours."""
        self.robots = set(robots)
        self.lost = False
        self.orphan = False
        self.echoed_at: float | None = None
        self.ends = ends
        """The time at which this flood is forgotten, s."""


class Waves:
    """The confirmed floods that this robot takes part in."""

    def __init__(
        self,
        me: str,
        emit: Emit,
        *,
        towards: Callable[[str], str | None],
        heard: Callable[[FloodId, Collection[str], bool, bool, float], None],
    ) -> None:
        """`towards(robot)` is the neighbour on the way there; `heard(id, robots, lost, over, now)` is called at the
        origin, with `over` when all edges have spoken, else when an orphan's echo came."""
        self._me = me
        self._emit = emit
        self._towards = towards
        self._heard = heard
        self._waves: OrderedDict[FloodId, Wave] = OrderedDict()

    def __len__(self) -> int:
        return len(self._waves)

    def begin(
        self, id: FloodId, key: str, priority: int, links: Collection[str], now: float, life: float = 0.0
    ) -> None:
        """Our own flood has left on all links; it may take `life` s longer than a small one."""
        self._join(id, Wave(key, priority, None, set(links), (self._me,), now + LIFE + life), now)

    def join(
        self,
        id: FloodId,
        key: str,
        priority: int,
        parent: str,
        others: Collection[str],
        now: float,
        robots: Collection[str] | None = None,
        *,
        coming: bool = False,
        life: float = 0.0,
    ) -> None:
        """The first copy of another's flood came from `parent` and was passed on to the others. It has reached
        `robots`, usually us; with `coming` we shall be one of them when `came` says so, and are waited for."""
        wave = Wave(key, priority, parent, set(others), (self._me,) if robots is None else robots, now + LIFE + life)
        wave.lost = robots is not None and not robots and not coming
        if coming:
            wave.pending.add(self._me)
        self._join(id, wave, now)

    def came(self, id: FloodId, now: float, *, complete: bool) -> None:
        """The message that a flood has announced is there, or will never be."""
        wave = self._waves.get(id)
        if wave is not None and self._me in wave.pending:
            if complete:
                wave.robots.add(self._me)
            else:
                wave.lost = True
            self._settle(id, wave, self._me, now)

    def again(self, id: FloodId, key: str, priority: int, peer: str, now: float) -> None:
        """Take a further copy, which is the message that this edge owed us. On a new edge the other end waits for
        ours."""
        wave = self._waves.get(id)
        if wave is not None and peer in wave.pending:
            self._settle(id, wave, peer, now)
        elif wave is None or peer not in wave.spoken:
            if wave is not None:
                wave.spoken.add(peer)
            self._send(peer, key, priority, EchoPacket(id.incarnation, id.sequence, ()))

    def echo(self, id: FloodId, key: str, priority: int, peer: str, echo: EchoPacket, now: float) -> None:
        """Take an answer."""
        wave = self._waves.get(id)
        if wave is None:
            if echo.orphan:
                self._pass_on(id, key, priority, echo, None, peer)
            return
        if echo.orphan:
            if id.origin == self._me:
                wave.robots.update(echo.robots)
                self._heard(id, wave.robots, True, wave.echoed_at is not None, now)
            elif wave.echoed_at is None:
                wave.robots.update(echo.robots)
                wave.lost |= echo.lost
            else:
                self._pass_on(id, key, priority, echo, wave.parent, peer)
        elif peer in wave.pending:
            wave.robots.update(echo.robots)
            wave.lost |= echo.lost
            self._settle(id, wave, peer, now)

    def link_down(self, peer: str, now: float) -> None:
        """Note that a neighbour will say nothing any more."""
        for id, wave in list(self._waves.items()):
            wave.spoken.discard(peer)
            if wave.parent == peer:
                wave.orphan = True
                wave.parent = self._other_way(id, {peer})
                if wave.echoed_at is not None and wave.echoed_at + RECENT >= now:
                    self._answer(id, wave)
            if peer in wave.pending:
                wave.lost = True
                self._settle(id, wave, peer, now)

    def handle_timer(self, now: float) -> None:
        """Forget what is old; cheap enough to be called at any time."""
        while self._waves:
            id, wave = next(iter(self._waves.items()))
            if wave.ends > now:
                return
            del self._waves[id]

    def forget(self, id: FloodId) -> None:
        """The origin has its answer."""
        self._waves.pop(id, None)

    # -- inside ------------------------------------------------------------------------------------------------

    def _join(self, id: FloodId, wave: Wave, now: float) -> None:
        if len(self._waves) >= MAX_WAVES:
            self._waves.popitem(last=False)
        self._waves[id] = wave
        if not wave.pending:
            self._over(id, wave, now)

    def _settle(self, id: FloodId, wave: Wave, peer: str, now: float) -> None:
        wave.pending.discard(peer)
        if not wave.pending and wave.echoed_at is None:
            self._over(id, wave, now)

    def _over(self, id: FloodId, wave: Wave, now: float) -> None:
        wave.echoed_at = now
        if id.origin == self._me:
            self._heard(id, wave.robots, wave.lost, True, now)
        else:
            self._answer(id, wave)

    def _answer(self, id: FloodId, wave: Wave) -> None:
        if wave.parent is not None:
            wave.spoken.add(wave.parent)
            robots = tuple(sorted(wave.robots))
            echo = EchoPacket(id.incarnation, id.sequence, robots, wave.lost, wave.orphan, ORPHAN_TTL * wave.orphan)
            self._send(wave.parent, wave.key, wave.priority, echo)

    def _pass_on(self, id: FloodId, key: str, priority: int, echo: EchoPacket, parent: str | None, source: str) -> None:
        way = parent if parent is not None and parent != source else self._other_way(id, {source})
        if way is not None and echo.ttl > 1:
            self._send(way, key, priority, echo._replace(ttl=echo.ttl - 1))

    def _other_way(self, id: FloodId, not_by: Collection[str]) -> str | None:
        way = self._towards(id.origin)
        return None if way in not_by else way

    def _send(self, peer: str, key: str, priority: int, echo: EchoPacket) -> None:
        self._emit(Transmit(peer, FLOOD, key, encode_echo(echo), priority))
