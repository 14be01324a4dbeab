"""The links that carry a topology: its own graph or a tree of few hubs, and who calls whom on Bluetooth.

On a radio with piconets a link for each edge makes robots wait for one another, since a robot in several piconets
attends to one at a time. A hub that calls all others forms a single piconet, and hands on what its robots tell each
other.

The order of the configuration is the order of hubs: the first robot calls up to seven others, the next ones call those
that are left. Of two robots the earlier one calls.

Later robots take over from a hub that is lost or does not hear a robot. Each robot calls the robots after itself that
it does not reach any more. It waits `PAUSE` s for each robot before it, and longer while an earlier one could call.

Where links are those of the graph, who calls is the central of a piconet with all that it calls. So a robot should
either call all its neighbours or be called by them: on a graph of two sides one side calls. On other graphs
several first choices are tried, and calls of each are turned one by one as long as that makes waiting shorter. All
robots find the same, from their configuration.
"""

from collections.abc import Collection, MutableMapping, Sequence, Set
from itertools import combinations

from swarm.config.types import AUTO_LINKS, GRAPH, MAX_RFCOMM_LINKS, TREE, Config
from swarm.core.graph import Edge

SLOTS = "slots:"
"""The beginning of the link of a robot on a simulated Bluetooth radio."""

_NEVER = float("inf")


def links_of(config: Config, *, bluetooth: bool = False) -> str:
    """Return which links carry the topology: `graph`, or what asks for others; `bluetooth`: as if all links were of
    Bluetooth."""
    if config.mesh.links != AUTO_LINKS:
        return config.mesh.links
    if config.auto:
        return GRAPH  # robots look for links themselves
    others = len(config.robots) - 1
    one_hub = len(config.edges) == others and any(len(config.neighbours(name)) == others for name in config.names)
    fits = one_hub and others <= MAX_RFCOMM_LINKS
    return TREE if (bluetooth or is_bluetooth(config)) and not fits else GRAPH


def is_bluetooth(config: Config) -> bool:
    """Return whether all links are of Bluetooth, of real radios or of a simulated one."""
    return all(each.link.startswith(SLOTS) if each.link else each.bluetooth for each in config.robots)


def is_measured(config: Config) -> bool:
    """Return whether round trips decide which robot is the hub: where the configuration leaves the links to the mesh,
    and one hub calls all robots."""
    auto = config.mesh.links == AUTO_LINKS and links_of(config) != GRAPH
    return auto and len(config.robots) <= MAX_RFCOMM_LINKS + 1


def calls_of(config: Config) -> Collection[tuple[str, str]]:
    """Return who calls whom, where the configuration says it: of a fixed topology whose links are of Bluetooth, and of
    links that are not the topology's own."""
    if links_of(config) != GRAPH:
        return calls(config.names)
    if config.auto or not is_bluetooth(config):
        return ()
    return callers(config.names, config.edges)


def physical(names: Sequence[str], edges: Sequence[Edge], way: str) -> tuple[Edge, ...]:
    """Return the links that carry the topology `edges`; `way` is `swarm.config.types.MeshConfig.links`. A star is the
    tree of at most eight robots."""
    return tuple(edges) if way == GRAPH else tuple((names[_hub(place)], names[place]) for place in range(1, len(names)))


def calls(names: Sequence[str]) -> Collection[Edge]:
    """Return who calls whom of all pairs, where links are not those of the topology."""
    return frozenset(combinations(names, 2))


def follow(dials: MutableMapping[str, bool], order: Sequence[str], me: str) -> set[str]:
    """Let `dials` say whom this robot calls in this order of hubs, and return the robots for which it has said
    otherwise before."""
    place = {name: number for number, name in enumerate(order)}
    turned = {peer for peer, calls in dials.items() if calls != (place[me] < place[peer])}
    for peer in turned:
        dials[peer] = not dials[peer]
    return turned


def _hub(place: int) -> int:
    """Return the place of the hub that has a link with the robot at this place. All hubs but the first have one of
    their own besides, so they call six."""
    return 0 if place <= MAX_RFCOMM_LINKS else 1 + (place - MAX_RFCOMM_LINKS - 1) // (MAX_RFCOMM_LINKS - 1)


PAUSE = 1.5
"""Seconds for each earlier robot until a lost one is called by a robot that is not its hub."""

BRIDGE = 10.0
"""Seconds besides, while an earlier one is in reach: that one is about to call. Then it does not hear the lost one."""

UNSEEN = 20.0
"""Seconds besides, for one that was never there: the first hub calls one robot after the other, and robots are switched
on so."""

FLEETING = 5.0
"""Seconds in reach after which a robot is no longer lost: the map of who has just lost a hub holds old news for a
while."""


class Succession:
    """The times at which a robot calls others than those of which it is the hub."""

    def __init__(self, names: Sequence[str], me: str) -> None:
        """`names`: all robots in the order of hubs."""
        self._me = me
        self.reorder(names)
        self._lost: dict[str, float] = {}
        """Robots out of reach, and since when; the time for one that was never there is `UNSEEN` later."""
        self._back: dict[str, float] = {}
        """The lost robots that seem to be in reach again, and since when."""
        self._seen: set[str] = set()
        """Robots that were in reach at any time."""
        self._next = _NEVER

    def reorder(self, names: Sequence[str]) -> None:
        """Take another order of hubs."""
        self._earlier = names[: names.index(self._me)]
        self._pause = PAUSE * len(self._earlier)

    def due(self, far: Collection[str], reachable: Set[str], now: float) -> list[str]:
        """Return the robots to call now, of those out of reach that this one may call."""
        for name in reachable - self._seen:
            self._lost.pop(name, None)
        self._seen |= reachable
        for name in far:
            self._lost.setdefault(name, now if name in self._seen else now + UNSEEN)
        self._back = {name: self._back.get(name, now) for name in self._lost.keys() - set(far)}
        for name in [name for name, since in self._back.items() if now >= since + FLEETING]:
            del self._lost[name]
        bridge = 0.0 if reachable.isdisjoint(self._earlier) else BRIDGE
        # `UNSEEN` was for the first hub alone.
        unseen = 0.0 if reachable.isdisjoint(self._earlier[1:]) else BRIDGE
        calls_from = {name: self._lost[name] + self._pause + (bridge if name in self._seen else unseen) for name in far}
        self._next = min((at for at in calls_from.values() if now < at), default=_NEVER)
        return [name for name, at in calls_from.items() if now >= at]

    def next_deadline(self) -> float:
        """Return the time at which `due` has more, as long as the same robots are in reach."""
        return self._next


# -- who calls whom on the links of a graph ------------------------------------------------------------------

CENTRAL, PERIPHERAL = "central", "peripheral"
"""The role that who calls is to have, and that of who is called."""

MOST = 32
"""Links of a graph up to which calls are turned; beyond, the sides alone decide."""


def callers(names: Sequence[str], edges: Sequence[Edge]) -> frozenset[Edge]:
    """Return the links, each with its caller first."""
    links = sorted((min(edge), max(edge)) for edge in edges)
    first = _by_sides(names, links)
    if len(links) > MOST:
        return frozenset(first)
    # Turning single calls ends at the best choice near the first one, so several are tried.
    order = sorted(names)
    starts = [first, _by_circle(order, links)]
    starts += [_by_circle([name for name in order if name != last], links) for last in order]
    best = min(map(_turned, starts), key=waiting)
    return frozenset(best)


def _by_sides(names: Sequence[str], links: Sequence[Edge]) -> list[Edge]:
    """Let one side call the other, as far as a graph has two sides."""
    near: dict[str, list[str]] = {name: [] for name in names}
    for a, b in links:
        near[a].append(b)
        near[b].append(a)
    # The side with more links a robot is called less: in a star the hub calls, as the robot with most neighbours.
    calls: dict[str, bool] = {}
    for first in sorted(names, key=lambda name: (-len(near[name]), name)):
        todo = [first] if first not in calls else []
        calls.setdefault(first, True)
        for here in todo:
            for other in sorted(near[here]):
                if other not in calls:
                    calls[other] = not calls[here]
                    todo.append(other)
    return [(a, b) if (not calls[a], a) < (not calls[b], b) else (b, a) for a, b in links]


def _by_circle(order: Sequence[str], links: Sequence[Edge]) -> list[Edge]:
    """Let each robot call the half of the circle behind it, so that all call and are called alike. A robot that is not
    in the circle is called by all."""
    place = {name: number for number, name in enumerate(order)}
    found = []
    for a, b in links:
        steps = (place[b] - place[a]) % len(order) if a in place and b in place else len(order) * (a not in place)
        found.append((a, b) if 2 * steps <= len(order) else (b, a))
    return found


def _turned(links: list[Edge]) -> list[Edge]:
    """Turn calls while that helps."""
    best, better = waiting(links), True
    while better:
        better = False
        for place, (caller, called) in enumerate(links):
            links[place] = called, caller
            if (found := waiting(links)) < best:
                best, better = found, True
            else:
                links[place] = caller, called
    return links


def piconets(links: Sequence[Edge]) -> dict[str, int]:
    """Return in how many piconets each robot is."""
    found: dict[str, set[str]] = {}
    for caller, called in links:
        found.setdefault(caller, set()).add(caller)
        found.setdefault(called, set()).add(caller)
    return {name: len(each) for name, each in found.items()}


def waiting(links: Sequence[Edge]) -> tuple[int, int]:
    """Return how long frames wait for both ends to be in a link's piconet, as the product of the ends' piconets: of
    the worst link, and of all together."""
    number = piconets(links)
    each = [number[caller] * number[called] for caller, called in links]
    return max(each, default=0), sum(each)
