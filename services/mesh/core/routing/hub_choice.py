"""The choice of the hub by measured round trips, where the configuration leaves the links to the mesh (`links = auto`).

The hub measures what no other robot can: the mean round trip between itself and all robots in reach, by its heartbeats.
The shorter that is, the faster is a star; its slowest link alone does not tell (docs/explanation/hub.md). The
hub is slow when the mean is above `SLOW` s (a poor place), when it is above the median by the factor `PAYS` (a weak
link), or when a robot in reach has no link with it. If that lasts for `SUSTAINED` s, another robot becomes the hub on
trial, and measures for `TRIAL` s. It stays the hub if its mean is shorter by the factor `PAYS` and it has lost no
robot. Otherwise it hands back, and the time until the next trial doubles. It hands back sooner where it has lost a
robot, or where its mean is longer by that factor after `MEASURED` s.

The choice is part of the topology (`routing.topology.Hub`), so all robots come to have the same one. While the hub is
away nobody decides: other robots take over its calls (`routing.physical_links.Succession`) and hand them back.
"""

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from statistics import fmean, median
from typing import NamedTuple

from services.mesh.core.routing.link_state import LinkStateMap
from services.mesh.core.routing.topology import MAX_ROUND_TRIP, Hub
from swarm.messages import MeasuredHub

SLOW = 0.1
"""Mean round trip of a slow hub, s. On the slot radio a hub of six robots has 0.04, one of eight on the full graph has
0.075 (`./run bench radio`)."""

PAYS = 1.5
"""Factor by which another hub's mean must be shorter: a change slows the swarm for some seconds."""

SUSTAINED = 60.0
"""Seconds for which a hub must have been slow without a break until another one is tried."""

TRIAL = 60.0
"""Seconds of a trial."""

MEASURED = 30.0
"""The last seconds, of which the mean is taken. New links need some time before."""

LOST = 20.0
"""Seconds from the beginning of a trial after which all robots must be in reach that were so before."""

REST, LONGEST_REST = 600.0, 4 * 3600.0
"""Seconds after a trial without another one; twice as many after each in vain, up to the second number."""

EVERY = 5.0
"""Seconds between two looks at the round trips."""

_NEVER = float("inf")


class Reached(NamedTuple):
    """A robot that is in reach of the hub."""

    round_trip: float
    """s, along the hub's route to it."""
    hops: int
    links: int
    """How many links it has."""


def in_reach(me: str, place: Mapping[str, int], map: LinkStateMap) -> dict[int, Reached]:
    """Return the robots in reach of `me` by their places in the configuration, which `place` gives by name."""
    own, found = map.links(me), {}
    for name, route in map.routes().items():
        one_way = 1e-4 * (own[name] if route.hops == 1 else route.time)
        found[place[name]] = Reached(2.0 * one_way, route.hops, len(map.links(name)))
    return found


def is_slow(reached: Collection[Reached], mean: float, middle: float) -> bool:
    """Return whether a hub is slow. `mean` and `middle`, the median, of its round trips are those of some time, s."""
    return mean > SLOW or mean > PAYS * middle or any(each.hops > 1 for each in reached)


def verdict(hub: Hub, mean: float) -> Hub:
    """Return the choice at the end of the trial `hub`, in which the mean round trip was `mean` s."""
    if PAYS * mean * 1e3 <= hub.round_trip:
        return hub._replace(trial=False)
    return handed(hub.before, hub.place, mean)


def handed(place: int, before: int, mean: float | None, *, trial: bool = False) -> Hub:
    """Return the choice of the robot at `place` after the one at `before`, whose mean round trip was `mean` s."""
    return Hub(place, before, min(round((mean or 0.0) * 1e3), MAX_ROUND_TRIP), trial)


def candidate(reached: Mapping[int, Reached], tried: Collection[int]) -> int | None:
    """Return the place of the robot to try as the next hub, None where all those in reach have been tried.

    A robot with several links stands in for a link of the hub, so it hears a robot that the hub does not hear. Among
    others the shortest round trip decides: a robot with a fast link is in no poor place itself.
    """
    untried = [place for place in reached if place not in tried]
    return min(untried, key=lambda at: (reached[at].links < 2, reached[at].round_trip, at), default=None)


class HubChoice:
    """The choice that one robot makes while it is the hub. Calls with `now` must not go back in time."""

    def __init__(self, place: int) -> None:
        """`place` of this robot in the configuration."""
        self._place = place
        self._since = 0.0
        """The time at which the choice came into force."""
        self._had: frozenset[int] = frozenset()
        """Places of the robots that were in reach then."""
        self._looks: deque[tuple[float, float, float]] = deque()
        """Times of the last looks, and mean and median of the round trips, s."""
        self._slow_since: float | None = None
        self._tried: set[int] = set()
        self._rest = REST
        self._rest_until = 0.0
        self._next = _NEVER

    @property
    def mean(self) -> float | None:
        """Mean round trip between this hub and the robots in reach over the last `MEASURED` s; None: not measured."""
        return fmean(mean for _, mean, _ in self._looks) if self._looks else None

    def told(self, hub: Hub, names: Sequence[str]) -> MeasuredHub:
        """Return the choice in force for the key `mesh/topology`."""
        before = names[hub.before] if hub.before != hub.place else ""
        return MeasuredHub(names[hub.place], self.mean, before, hub.round_trip * 1e-3 or None, hub.trial)

    def next_deadline(self) -> float:
        """Return the time of the next look; infinite before `begin`, and while another robot is the hub."""
        return self._next

    def begin(self, now: float) -> None:
        """Note that the robot has started."""
        self._since = self._next = now

    def adopted(self, hub: Hub, reached: Collection[int], now: float) -> None:
        """Note that a choice is in force from now on. `reached`: places of the robots in reach."""
        self._since = self._next = now
        self._had = frozenset(reached)
        self._looks.clear()
        self._slow_since = None
        if hub.place == self._place and hub.trial:
            self._tried.clear()
            self._rest = REST
        elif hub.place == self._place:
            self._rest_until = now + self._rest
            self._rest = min(2.0 * self._rest, LONGEST_REST)

    def look(self, hub: Hub, reached: Mapping[int, Reached], now: float) -> Hub:
        """Return the choice that is to hold from now on, `hub` where nothing changes. `reached` has the robots in reach
        by place."""
        if now < self._next:
            return hub
        if hub.place != self._place:
            self._next = _NEVER
            return hub
        self._next = now + EVERY
        if reached:
            times = [each.round_trip for each in reached.values()]
            self._looks.append((now, fmean(times), median(times)))
        while self._looks and self._looks[0][0] <= now - MEASURED:
            self._looks.popleft()
        return self._on_trial(hub, reached, now) if hub.trial else self._in_office(hub, reached, now)

    def _on_trial(self, hub: Hub, reached: Mapping[int, Reached], now: float) -> Hub:
        """Go on with the trial, hand back, or stay the hub."""
        if hub.before not in reached:
            return hub  # nobody is there to hand back to
        if now >= self._since + LOST and not self._had <= reached.keys() | {self._place}:
            return handed(hub.before, self._place, None)
        if now >= self._since + MEASURED and self._looks and self._looks[-1][1] * 1e3 > PAYS * hub.round_trip:
            return handed(hub.before, self._place, self._looks[-1][1])
        if now < self._since + TRIAL:
            return hub
        mean = self.mean
        return handed(hub.before, self._place, None) if mean is None else verdict(hub, mean)

    def _in_office(self, hub: Hub, reached: Mapping[int, Reached], now: float) -> Hub:
        """Stay the hub, or have another robot tried."""
        mean = self.mean
        if mean is None or not is_slow(reached.values(), mean, fmean(middle for *_, middle in self._looks)):
            self._slow_since = None
            return hub
        if self._slow_since is None:
            self._slow_since = now
        if now < max(self._slow_since + SUSTAINED, self._rest_until):
            return hub
        if (place := candidate(reached, self._tried)) is None:
            self._tried.clear()
            return hub
        self._tried.add(place)
        return handed(place, self._place, mean, trial=True)
