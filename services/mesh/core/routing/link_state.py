"""The links of the whole swarm: each robot floods its own links (LSA), and computes routes from those of all.

An LSA is the latest value of the key `swarm/<robot>/mesh/lsa`: duplicates, restarts and repair are the flood's
business. A link that is lost is told at once, before the messages that now take another way (so the robots on that
way know already, and nothing runs in circles); everything else waits 0.2 s for more of its kind. An edge counts only
if both ends report it; of our own links we know better. An LSA that was not repeated for three minutes is dropped.
"""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import lru_cache

from services.mesh.core.routing.topology import (
    Advertisement,
    Route,
    Weight,
    decode_advertisement,
    encode_advertisement,
    routes,
    routes_by_hops,
)
from swarm.errors import FrameError

HOPS, TIME = "hops", "time"
"""Metrics: every edge 1, or the measured one-way time."""

HOLD_DOWN = 0.2
"""Seconds that good news wait for more, so that a robot with seven links says it once."""

RATE, BURST = 1.0, 5
"""LSAs a second, and how many at once after a quiet time: links that break must be told without delay."""

REFRESH = 60.0
"""Seconds between two LSAs when nothing changes, spread by a tenth."""

MAX_AGE = 3 * REFRESH
"""Seconds without a new LSA after which a robot's links are forgotten."""

TRUSTED = 2.0
"""Seconds for which a new link of ours counts although the other end has not reported it yet."""

UNKNOWN_TIME = 300
"""Taken for the one-way time of a link that was not measured yet: 30 ms."""

STEP = 1.2
"""Times go in steps of 20 %, and change only past three quarters of a step: noise must not flood the swarm."""

_MAX_LEVEL = int(math.log(65535, STEP))
_ROUNDING = 1e-6
"""Seconds by which sums of times may be wrong; without it a deadline could come round for ever."""

_NEVER = float("inf")


class Level:
    """A measured time in steps, with hysteresis."""

    def __init__(self) -> None:
        self._level: int | None = None

    @property
    def time(self) -> int:
        """Units of 0.1 ms, at least 1."""
        return UNKNOWN_TIME if self._level is None else round(STEP**self._level)

    @property
    def known(self) -> bool:
        """Whether it was measured at all."""
        return self._level is not None

    def measured(self, seconds: float) -> bool:
        """Take a smoothed one-way time in; whether the step is another one now."""
        exact = math.log(max(seconds * 1e4, 1.0), STEP)
        if self._level is not None and abs(exact - self._level) <= 0.75:
            return False
        level = min(max(round(exact), 0), _MAX_LEVEL)
        changed = level != self._level
        self._level = level
        return changed


@dataclass(eq=False)
class _Own:
    """One of our links that is up."""

    since: float
    new: bool = True
    """Whether it counts without the other end's word."""
    level: Level = field(default_factory=Level)


@dataclass(eq=False)
class AdvertisedLinks:
    """The links that another robot reports."""

    incarnation: int
    advertisement: Advertisement
    heard: float


@lru_cache(maxsize=1024)
def _edge(metric: str, time: int) -> Weight:
    # Times come in steps, so a large map has many equal edges.
    return Weight(1 if metric == HOPS else time, time)


class LinkStateMap:
    """The map of one robot."""

    def __init__(
        self,
        me: str,
        robots: frozenset[str],
        *,
        metric: str,
        publish: Callable[[bytes], None],
        aged: Callable[[str], None],
        returned: Callable[[str], None],
        random: Callable[[], float],
        process: int = 0,
    ) -> None:
        """`robots` of the configuration: an LSA that names another one is refused. `process` is the number of this mesh
        process, 0 where it has none. `publish(payload)` floods the own LSA; `aged(robot)` is called for one that was
        dropped by age, `returned(robot)` for one that was not known, or not any more."""
        self._me = me
        self._robots = robots
        self._metric = metric
        self._publish = publish
        self._aged, self._returned = aged, returned
        self._random = random
        self._links: dict[str, _Own] = {}
        self._known: dict[str, AdvertisedLinks] = {}
        """Never changed in place: robots of a simulation share them, and the table as long as it is as `settle` gave
        it."""
        self._borrowed = False
        """Whether it is."""
        self._settled: dict[str, int] = {}
        """Links that the others know of already although they are not up yet."""
        self._due = _NEVER
        self._refresh_at = _NEVER
        self._credit, self._credit_at = float(BURST), 0.0
        self._leaving = False
        self._topology = self._heard = 0
        self._process = process
        self._twins: tuple[str, ...] = ()
        self.tellers: set[str] = set()
        """Robots whose LSA names twins."""
        self._routes: dict[str, Route] | None = {}
        self._avoiding: dict[tuple[str, tuple[str, str]], Route | None] = {}
        """Ways that avoid a link, by their end and the ends of that link."""
        self._trust_ends = _NEVER
        self._oldest_at = _NEVER
        self.version = 0
        """Goes up when routes may have changed."""

    # -- inputs ------------------------------------------------------------------------------------------------

    def settle(self, links: Mapping[str, int], known: dict[str, "AdvertisedLinks"], now: float) -> None:
        """Begin in a swarm that has been there for long: the others have an LSA with these links of ours (one-way
        times, 0.1 ms) already, and we have theirs, `known`, in which there may be our own. Large simulations begin so
        (docs/reference/simulation.md)."""
        self._settled = dict(links)
        self._known, self._borrowed = known, True
        self._refresh_at = now + REFRESH * (0.9 + 0.2 * self._random())
        self._oldest_at = now + MAX_AGE
        self._changed()

    def link_up(self, peer: str, now: float) -> bool:
        """Take a new link of ours; return whether that is news to the swarm."""
        own = self._links[peer] = _Own(now)
        time = self._settled.pop(peer, None)
        if time is not None:
            own.new = False
            own.level.measured(time * 1e-4)
            self._changed()
            return False
        self._trust_ends = min(self._trust_ends, now + TRUSTED)
        self._changed()
        self._due = min(self._due, now + HOLD_DOWN)
        return True

    def link_down(self, peer: str, now: float) -> None:
        """Take the end of a link of ours."""
        if self._links.pop(peer, None) is not None:
            self._own_known()
            self._changed()
            self._due = now
            self.handle_timer(now)

    def measured(self, peer: str, rtt: float, now: float) -> None:
        """Take the smoothed round-trip time of a link."""
        link = self._links.get(peer)
        if link is None:
            return
        first = not link.level.known
        # With hops as metric the time only says how long to wait for an answer: later changes go with the next LSA.
        if link.level.measured(rtt / 2) and (first or self._metric == TIME):
            self._changed()
            self._due = min(self._due, now + HOLD_DOWN)

    def tell(self, topology: int, heard: int, now: float) -> None:
        """Set what else this robot reports: the topology that holds here, and which robots it hears."""
        if (topology, heard) != (self._topology, self._heard):
            self._topology, self._heard = topology, heard
            self._due = min(self._due, now + HOLD_DOWN)

    def tell_twins(self, twins: tuple[str, ...], now: float) -> None:
        """Tell the names that two robots have, as this robot has seen."""
        if twins != self._twins:
            self._twins = twins
            self._due = min(self._due, now + HOLD_DOWN)

    def leave(self, now: float) -> None:
        """This robot's mesh stops: tell the others that it is no accident."""
        self._leaving = True
        self._due, self._credit = now, float(BURST)
        self.handle_timer(now)

    def receive(self, origin: str, incarnation: int, payload: bytes, now: float) -> None:
        """Take a flooded LSA of another robot. Raises `FrameError`."""
        advertisement = decode_advertisement(payload)
        if not advertisement.neighbours.keys() <= self._robots:
            raise FrameError(f"LSA of {origin}: a neighbour is not in our configuration")
        known = self._known.get(origin)
        same = known is not None and known.advertisement == advertisement and known.incarnation == incarnation
        if known is None:
            self._returned(origin)
        self._own_known()[origin] = AdvertisedLinks(incarnation, advertisement, now)
        if advertisement.twins:
            self.tellers.add(origin)
        else:
            self.tellers.discard(origin)
        self._oldest_at = min(self._oldest_at, now + MAX_AGE)
        if not same:
            self._changed()

    def handle_timer(self, now: float) -> None:
        """Do everything that is due at `now`."""
        if now >= min(self._due, self._refresh_at):
            self._credit = min(BURST, self._credit + (now - self._credit_at) * RATE)
            self._credit_at = now
            if self._credit >= 1.0 - _ROUNDING:
                self._credit -= 1.0
                self._due = _NEVER
                self._refresh_at = now + REFRESH * (0.9 + 0.2 * self._random())
                times = {peer: link.level.time for peer, link in self._links.items()}
                links = {} if self._leaving else times
                told = Advertisement(links, self._leaving, self._topology, self._heard, self._process, self._twins)
                self._publish(encode_advertisement(told))
            else:
                self._due = now + (1.0 - self._credit) / RATE + _ROUNDING
        if now >= self._trust_ends:
            for link in self._links.values():
                link.new = link.since + TRUSTED > now
            self._trust_ends = min((link.since for link in self._links.values() if link.new), default=_NEVER) + TRUSTED
            self._changed()
        if now >= self._oldest_at:
            table = self._own_known()
            for origin in [name for name, known in table.items() if known.heard + MAX_AGE <= now]:
                del table[origin]
                self.tellers.discard(origin)
                self._aged(origin)
                self._changed()
            self._oldest_at = min((known.heard for known in self._known.values()), default=_NEVER) + MAX_AGE

    def next_deadline(self) -> float:
        """Return the time at which `handle_timer` must be called."""
        return min(self._due, self._refresh_at, self._trust_ends, self._oldest_at)

    # -- outputs -----------------------------------------------------------------------------------------------

    def neighbours(self) -> Collection[str]:
        """Return the robots that we have a link to."""
        return self._links.keys()

    def route(self, to: str, avoided: tuple[str, str] | None = None) -> Route | None:
        """Return the way to a robot that does not use the link between the robots `avoided`; None where there is
        none."""
        if avoided is None:
            return self.routes().get(to)
        if (to, avoided) not in self._avoiding:
            graph = self.graph()
            for a, b in (avoided, avoided[::-1]):
                graph.get(a, {}).pop(b, None)
            self._avoiding[to, avoided] = routes(self._me, graph).get(to)
        return self._avoiding[to, avoided]

    def routes(self) -> dict[str, Route]:
        """Return the ways to all robots that can be reached."""
        if self._routes is None and self._metric == HOPS:
            told = {name: known.advertisement.neighbours for name, known in self._known.items()}
            self._routes = routes_by_hops(self._me, self._own_times(), told)
        elif self._routes is None:
            self._routes = routes(self._me, self.graph())
        return self._routes

    def graph(self) -> dict[str, dict[str, Weight]]:
        """Return all edges that count, both directions of each with the same cost."""
        own = {peer: self._edge(time, 0) for peer, time in self._own_times().items()}
        graph = {self._me: own}
        for name, known in self._known.items():
            if name == self._me:
                continue
            edges: dict[str, Weight] = {}
            for peer, time in known.advertisement.neighbours.items():
                if peer == self._me:
                    if name in own:
                        edges[peer] = own[name]
                    continue
                other = self._known.get(peer)
                back = other.advertisement.neighbours.get(name) if other is not None else None
                if back is not None:
                    edges[peer] = self._edge(time, back)
            graph[name] = edges
        return graph

    def told(self) -> dict[str, Collection[str]]:
        """Return the neighbours that each of the others says it has a link to."""
        return {name: known.advertisement.neighbours for name, known in self._known.items() if name != self._me}

    @property
    def undisturbed(self) -> bool:
        """Whether the swarm is as `settle` was told: all links came up, and nobody has told anything new."""
        return self._borrowed and not self._settled

    def links(self, name: str) -> dict[str, int]:
        """Return the links that a robot says it has, and their one-way times in units of 0.1 ms; this robot's as they
        are."""
        if name == self._me:
            return {peer: link.level.time for peer, link in self._links.items()}
        known = self._known.get(name)
        return dict(known.advertisement.neighbours) if known is not None else {}

    def advertised(self, name: str) -> Advertisement | None:
        """Return what another robot reports of its links; None where nothing is known."""
        known = self._known.get(name)
        return known.advertisement if known is not None and name != self._me else None

    def topology(self, name: str) -> int:
        """Return the tag of the topology at a robot, as far as it is known."""
        if name == self._me:
            return self._topology
        known = self._known.get(name)
        return known.advertisement.topology if known is not None else -1

    def heard(self, name: str) -> int:
        """Return the robots that a robot has reached by calling them, as bits."""
        if name == self._me:
            return self._heard
        known = self._known.get(name)
        return known.advertisement.heard if known is not None else 0

    def has_left(self, name: str) -> bool:
        """Return whether a robot has said that it stops."""
        known = self._known.get(name)
        return known is not None and known.advertisement.leaving

    # -- inside ------------------------------------------------------------------------------------------------

    def _own_known(self) -> dict[str, AdvertisedLinks]:
        """Return the table of the others, to be changed."""
        if self._borrowed:
            self._borrowed = False
            self._known = {name: known for name, known in self._known.items() if name != self._me}
        return self._known

    def _own_times(self) -> dict[str, int]:
        """This robot's edges that count, and their times."""
        own: dict[str, int] = {}
        for peer, link in self._links.items():
            known = self._known.get(peer)
            theirs = known.advertisement.neighbours.get(self._me) if known is not None else None
            # An end that does not list us has given the link up already, unless its news are still on the way.
            if theirs is not None or known is None or link.new:
                own[peer] = max(link.level.time, theirs or 0)
        return own

    def _edge(self, time: int, back: int) -> Weight:
        return _edge(self._metric, max(time, back))

    def _changed(self) -> None:
        self._routes = None
        self._avoiding.clear()
        self.version += 1
