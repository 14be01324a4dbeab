"""The members of the swarm as one robot sees them: one has a route, has said that it stops, or is gone.

Nobody can tell a robot that crashed from one that went out of reach alone, so both are a `crash`; robots that are
gone at the same time and were linked with each other are a `partition`. Who comes back in the same incarnation was
only out of reach (`heal`), else it was started anew (`return`).

`Clashes` notices names that two robots have. `Survey` puts together what one robot knows of all the others, for
`mesh/graph`: members, their links, and who says that it is stopped. Each robot floods its `mesh/stopped` as a latest
value when it changes. So whoever stops the swarm sees on any robot's bus who has obeyed. A value counts for the
incarnation that has told it.
"""

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

from services.mesh.core.routing.link_state import LinkStateMap
from services.mesh.core.routing.topology import Route
from swarm.messages import GraphRobot, Member, MemberChange, MeshGraph, Stopped
from swarm.messages.codec import decode

SETTLE = 0.2
"""Seconds from a change of the graph until it is looked at: the news of one accident come from several robots."""

KEPT_CHANGES = 32
"""Changes that `mesh/members` shows."""

HERE, LEFT, GONE, NEVER = "here", "left", "gone", "never"
JOIN, LEAVE, RETURN, RESTART = "join", "leave", "return", "restart"
CRASH, PARTITION, HEAL = "crash", "partition", "heal"

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
        """The members that are not as usual: none in a settled swarm of a thousand."""
        self._told: Mapping[str, Collection[str]] = {}
        """The neighbours that each robot told of."""
        self.changes: deque[MemberChange] = deque(maxlen=KEPT_CHANGES)
        """The newest last."""

    def settle(self, told: Mapping[str, Collection[str]], now: float) -> None:
        """Begin with all robots here, and none of them as news. `told` as in `look`."""
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
        """Return the membership of one of the others."""
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


PAGE = 100
"""Robots in one answer at most."""

PAGE_LINKS = 1600
"""Links in one answer, where it has more than one robot. With this many a full page takes half of the 64 KiB that a
message on the bus may have; a robot may claim a link with each of 255 others."""


class Survey:
    """Puts together what the parts of the overlays know."""

    def __init__(
        self,
        me: str,
        names: Sequence[str],
        membership: Membership,
        links: LinkStateMap,
        incarnation: Callable[[str], int],
    ) -> None:
        """`names` of all robots, sorted; `incarnation(robot)` is the newest one heard of."""
        self._me = me
        self._names = names
        self._membership = membership
        self._links = links
        self._incarnation = incarnation
        self._stopped: dict[str, tuple[int, bool]] = {}

    def heard(self, origin: str, incarnation: int, key: str, payload: bytes) -> None:
        """Another robot's `mesh/stopped`; raises `PayloadError`."""
        self._stopped[origin] = incarnation, decode(Stopped, payload, key).stopped

    def graph(self, now: float, *, stopped: bool, after: str = "") -> MeshGraph:
        """Return the robots with names behind `after`; `stopped` says whether this one is."""
        names = [name for name in self._names if name > after]
        page: list[GraphRobot] = []
        links = 0
        for name in names[:PAGE]:
            robot = self._robot(name, stopped)
            links += len(robot.links)
            if page and links > PAGE_LINKS:
                break
            page.append(robot)
        return MeshGraph(now, tuple(page), len(names) > len(page))

    def _robot(self, name: str, stopped: bool) -> GraphRobot:
        links = {peer: time * 1e-4 for peer, time in sorted(self._links.links(name).items())}
        if name == self._me:
            return GraphRobot(name, "self", 0.0, 0, None, links, stopped)
        member = self._membership.member(name)
        incarnation, told = self._stopped.get(name, (0, False))
        current = incarnation == self._incarnation(name) and incarnation != 0
        return GraphRobot(name, member.state, member.since, member.hops, member.via, links, told if current else None)


NAMED_AFTER = 5.0
"""Seconds between the first and the last sign of a second robot until the clash is named. A robot that was started anew
looks like a second one until its neighbours have noticed that its earlier process is silent, 3 s at most."""

FORGET = 30.0
"""Seconds without a sign of the second robot after which the clash is over. A robot that is refused calls again after
7.5 s at most."""

DOUBT = 2.0
"""Seconds for which the link state must name another process than the one at the end of a link until that is a sign:
news of a new process take a moment to come round."""

PROBATION = 30.0
"""Seconds for which a link is young. A young link ends when the link state names another process: both robots were
switched on at the same time. An older link stays: what members tell cannot end it."""


class _Signs:
    """The signs of a second robot with one name."""

    def __init__(self, process: int, now: float) -> None:
        self.process = process
        """The one that is refused, or doubted. Another one each time is a robot that is started again and again."""
        self.first = now
        self.last = now
        self.text = ""


class Clashes:
    """The names of which this robot has seen two owners. Calls with `now` must not go back in time."""

    def __init__(self, me: str, robots: frozenset[str], map: LinkStateMap) -> None:
        """`map` holds the link state that all robots tell."""
        self._me = me
        self._robots = robots
        self._map = map
        self._signs: dict[str, _Signs] = {}
        self._doubts: dict[str, float] = {}
        """Links whose end is not the process that the link state names, and since when."""

    def elsewhere(self, robot: str, process: int) -> str | None:
        """Return a robot in reach, not this one, that has a link with another process of `robot` than `process`.
        None where there is none, or where processes are not known."""
        told = self._map.advertised(robot)
        if told is None or not told.process or not process or told.process == process or told.leaving:
            return None
        for peer in told.neighbours:
            other = self._map.advertised(peer)
            if peer != self._me and other is not None and robot in other.neighbours and self._map.route(peer):
                return peer
        return None

    def seen(self, robot: str, process: int, text: str, now: float) -> None:
        """Note a sign that a process is a second robot of this name; `text` says what the sign is."""
        signs = self._signs.get(robot)
        if signs is None or signs.process != process or now > signs.last + FORGET:
            signs = self._signs[robot] = _Signs(process, now)
        signs.last, signs.text = now, text

    def refusal(self, robot: str, process: int, linked: int, now: float) -> str:
        """Return why a process may have no link because another robot has its name; empty where it may. `linked` is the
        process that this robot has a link with; a process of 0 is not known."""
        if not process:
            return ""  # a caller that tells no process is taken for the robot that it names
        if linked not in (0, process):
            text = f"{self._me} has a link with one of them"
        elif (other := self.elsewhere(robot, process)) is not None:
            text = f"{other} has a link with one of them"
        else:
            return ""
        self.seen(robot, process, text, now)
        return f"another robot is called {robot}, too: {text}"

    def check_link(self, robot: str, process: int, since: float, now: float) -> str:
        """Look at a link that came up at `since`. The reason to end it; empty where it is to stay."""
        if (other := self.elsewhere(robot, process)) is None:
            self._doubts.pop(robot, None)
            return ""
        if now < self._doubts.setdefault(robot, now) + DOUBT:
            return ""
        text = f"{self._me} and {other} have links with two of them"
        self.seen(robot, process, text, now)
        return text if now < since + PROBATION else ""

    def link_down(self, robot: str) -> None:
        """Note that a link is gone."""
        self._doubts.pop(robot, None)

    def own(self, now: float) -> Iterator[str]:
        """Yield the names of which this robot itself has seen two owners."""
        for robot, signs in self._signs.items():
            if signs.last - signs.first >= NAMED_AFTER and now <= signs.last + FORGET:
                yield robot

    def named(self, now: float) -> dict[str, str]:
        """Return the names that two robots have, by what this robot or others in reach have seen, and what that is."""
        found = {robot: self._signs[robot].text for robot in self.own(now)}
        for teller in sorted(self._map.tellers):
            told = self._map.advertised(teller)
            if told is not None and self._map.route(teller) is not None:
                for robot in set(told.twins) & self._robots:
                    found.setdefault(robot, f"{teller} says so")
        return {robot: f"another robot is called {robot}, too: {text}" for robot, text in sorted(found.items())}
