"""Who is in the swarm, as one robot sees it: there is a way to it, or it said that it stops, or it is gone.

Nobody can tell a robot that crashed from one that went out of reach alone, so both are a `crash`; robots that are
gone at the same time and were linked with each other are a `partition`. Who comes back in the same incarnation was
only out of reach (`heal`), else it was started anew (`return`).
"""

from collections import deque
from collections.abc import Collection, Mapping
from typing import NamedTuple

from services.mesh.core.routing import Route
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

    def __init__(self, me: str, robots: Collection[str]) -> None:
        self._me = me
        self._members = dict.fromkeys(sorted(name for name in robots if name != me), _State(NEVER, 0, 0.0))
        self._told: Mapping[str, Collection[str]] = {}
        """The neighbours that each robot told of."""
        self._routes: Mapping[str, Route] = {}
        self.changes: deque[MemberChange] = deque(maxlen=KEPT_CHANGES)
        """The newest last."""

    def settle(self, now: float) -> None:
        """All are here, and have been for long: none of them is news."""
        self._members = dict.fromkeys(self._members, _State(HERE, 0, now))

    def look(
        self,
        routes: Mapping[str, Route],
        told: Mapping[str, Collection[str]],
        incarnations: Mapping[str, int],
        left: Collection[str],
        now: float,
    ) -> list[MemberChange]:
        """Compare with what was known; what has changed."""
        changes: list[MemberChange] = []
        gone: list[str] = []
        for name, old in self._members.items():
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
            together = any(other in near and name in self._told.get(other, ()) for other in gone)
            changes.append(MemberChange(now, name, PARTITION if together else CRASH))
        self._told, self._routes = told, routes
        self.changes += changes
        return changes

    def members(self) -> tuple[Member, ...]:
        """Everybody, by name; those never seen included."""
        return tuple(map(self.member, list(self._members)[:MAX_SHOWN]))

    def member(self, name: str) -> Member:
        """One of the others."""
        state = self._members[name]
        route = self._routes.get(name) if state.state == HERE else None
        hops, via = (route.hops, route.next_hop) if route is not None else (None, None)
        return Member(name, state.state, state.since, hops, via)


def _arrival(old: _State, incarnation: int) -> str | None:
    if old.state == NEVER:
        return JOIN
    if old.state == HERE:
        return RESTART if old.incarnation and incarnation != old.incarnation else None
    return HEAL if old.state == GONE and incarnation == old.incarnation else RETURN
