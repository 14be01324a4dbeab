"""Who is in the swarm, as one robot sees it: there is a way to it, or it said that it stops, or it is gone.

Nobody can tell a robot that crashed from one that went out of reach alone, so both are a `crash`; robots that are
gone at the same time and were linked with each other are a `partition`. Who comes back in the same incarnation was
only out of reach (`heal`), else it was started anew (`return`).
"""

from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

from services.mesh.core.routing.shortest_paths import Route
from swarm.messages import Member, MemberChange

SETTLE = 0.2
"""s from a change of the graph until it is looked at: the news of one accident come from several robots."""

KEPT_CHANGES = 32
"""Changes that `mesh/members` shows."""

HERE, LEFT, GONE, NEVER = "here", "left", "gone", "never"
JOIN, LEAVE, CRASH, PARTITION, HEAL, RETURN, RESTART = (
    "join", "leave", "crash", "partition", "heal", "return", "restart",
)  # fmt: skip

MAX_SHOWN = 500
"""Robots in `mesh/members`: a message on the bus has at most 64 KiB."""


class _State(NamedTuple):
    state: str
    incarnation: int
    since: float


class Membership:
    """The members of the swarm but this robot."""

    def __init__(self, me: str, names: Sequence[str], routes: Callable[[], Mapping[str, Route]]) -> None:
        """`names` of all robots, sorted; `routes()` are the ways to those in reach."""
        self._me = me
        self._names = names
        self._routes = routes
        self._usual = _State(NEVER, 0, 0.0)
        self._members: dict[str, _State] = {}
        """Those who are not as usual: in a swarm of a thousand that is settled nobody."""
        self._told: Mapping[str, Collection[str]] = {}
        """The neighbours that each robot told of."""
        self.changes: deque[MemberChange] = deque(maxlen=KEPT_CHANGES)
        """The newest last."""

    def settle(self, told: Mapping[str, Collection[str]], now: float) -> None:
        """All are here, and have been for long: none of them is news. `told` as `look` has it."""
        self._usual, self._members, self._told = _State(HERE, 0, now), {}, told

    def look(
        self,
        told: Mapping[str, Collection[str]],
        incarnations: Mapping[str, int],
        left: Collection[str],
        now: float,
    ) -> list[MemberChange]:
        """Compare with what was known; what has changed."""
        changes: list[MemberChange] = []
        gone: list[str] = []
        routes = self._routes()
        for name in self._names:
            if name == self._me:
                continue
            old = self._members.get(name, self._usual)
            incarnation = incarnations.get(name, 0) or old.incarnation
            if name in routes and name not in left:
                if old.state == HERE and old.incarnation == incarnation:
                    continue
                self._members[name] = _State(HERE, incarnation, old.since if old.state == HERE else now)
                if (what := _arrival(old, incarnation)) is not None:
                    changes.append(MemberChange(now, name, what))
                    if old.state == HERE:
                        self._members[name] = _State(HERE, incarnation, now)
            elif old.state in (HERE, GONE) and name in left:
                self._members[name] = _State(LEFT, incarnation, now)
                changes.append(MemberChange(now, name, LEAVE))
            elif old.state == HERE:
                self._members[name] = _State(GONE, old.incarnation, now)
                gone.append(name)
        for name in gone:
            # By the graph as it was: the links among those who are gone can no longer be heard of.
            near = self._told.get(name, ())
            partitioned = any(other in near and name in self._told.get(other, ()) for other in gone)
            changes.append(MemberChange(now, name, PARTITION if partitioned else CRASH))
        self._told = told
        self.changes += changes
        return changes

    def members(self) -> tuple[Member, ...]:
        """Everybody, by name; those never seen included."""
        return tuple([self.member(name) for name in self._names[: MAX_SHOWN + 1] if name != self._me])[:MAX_SHOWN]

    def member(self, name: str) -> Member:
        """One of the others."""
        state = self._members.get(name, self._usual)
        route = self._routes().get(name) if state.state == HERE else None
        hops, via = (route.hops, route.next_hop) if route is not None else (None, None)
        return Member(name, state.state, state.since, hops, via)


def _arrival(old: _State, incarnation: int) -> str | None:
    if old.state == NEVER:
        return JOIN
    if old.state == HERE:
        return RESTART if old.incarnation and incarnation != old.incarnation else None
    return HEAL if old.state == GONE and incarnation == old.incarnation else RETURN
