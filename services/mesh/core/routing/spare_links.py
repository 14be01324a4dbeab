"""The links of a robot that the topology in force does not contain: which of them are not needed any more.

Make before break. When a new topology comes into force, a link that it does not contain stays until
1. every robot in reach has the same value (its link state says so), or `PATIENCE` is over,
2. this robot's own links of it are up, as far as their other ends are in reach, or `MAKE` is over, and
3. for a while its two ends have been connected without it: by links of the topology, and unwanted ones of lower rank.
By 3 the links that stay are a minimum spanning forest with the topology's links at no cost (Kruskal 1956), so robots
that drop links at the same time, on old news even, never count on one another's: whatever is dropped, a chain of lower
ones remains. By 1 all ranks are of one value. So a link that alone holds two parts together stays for good
where its replacements never come up: a bad topology leaves a swarm that can be told a better one.
"""

from collections.abc import Iterable, Mapping, Set

from services.mesh.core.routing.link_state import LinkStateMap
from services.mesh.core.routing.topology import Ground, TopologyVersion
from swarm.core.graph import Edge

PATIENCE = 30.0
"""Seconds after which a robot in reach with another value is not waited for any more."""

MAKE = 10.0
"""Seconds after which new links are not waited for: a radio that is full has no room for them before old ones are
gone."""

GRACE = 1.0
"""Seconds for which the other way must have been there: what is being flooded has passed, routes have been told."""

_NEVER = float("inf")


class SpareLinks:
    """The spare links of one robot. Calls with `now` must not go back in time."""

    def __init__(self, me: str, ground: Ground, map: LinkStateMap) -> None:
        self._me = me
        self._ground = ground
        self._map = map
        self._since: dict[str, float] = {}
        """Unwanted links that are not needed any more, and since when."""

    def lost(self, peer: str) -> None:
        """Forget a link that is gone."""
        self._since.pop(peer, None)

    def forget(self) -> None:
        """Begin anew: another topology is in force."""
        self._since.clear()

    def is_agreed(self, value: TopologyVersion, adopted: float, now: float) -> bool:
        """Return whether all robots in reach have the value in force since `adopted`, or were waited for."""
        tag = self._ground.tag(value)
        return now >= adopted + PATIENCE or all(self._map.topology(name) == tag for name in self._map.routes())

    def needless(
        self, kept: Iterable[str], to_come: Set[str], value: TopologyVersion, adopted: float, now: float
    ) -> tuple[list[str], float]:
        """Return which of the links `kept` can go, and when to look again.

        `to_come` has the robots whose links of the topology are not up. The topology is in force since `adopted`.
        """
        agreed = self.is_agreed(value, adopted, now)
        made = now >= adopted + MAKE or not to_come & self._map.routes().keys()
        graph = self._map.graph() if agreed and made else {}
        topology = frozenset(self._ground.edge(a, b) for a, b in self._ground.physical(value))
        found, look_at = [], min((end for end in (adopted + MAKE, adopted + PATIENCE) if now < end), default=_NEVER)
        for peer in kept:
            if not graph or not self._is_connected(graph, topology, peer):
                self._since.pop(peer, None)
            elif now >= self._since.setdefault(peer, now) + GRACE:
                del self._since[peer]
                found.append(peer)
            else:
                look_at = min(look_at, self._since[peer] + GRACE)
        return found, look_at

    def _is_connected(self, graph: Mapping[str, Mapping[str, object]], topology: Set[Edge], peer: str) -> bool:
        """Return whether there is a way to a neighbour by links of the topology, and unwanted ones below its own."""
        limit = self._rank(self._ground.edge(self._me, peer))
        seen, todo = {self._me}, [self._me]
        while todo:
            here = todo.pop()
            for other in graph.get(here, ()):
                if other in seen:
                    continue
                edge = self._ground.edge(here, other)
                if edge in topology or self._rank(edge) < limit:
                    if other == peer:
                        return True
                    seen.add(other)
                    todo.append(other)
        return False

    def _rank(self, edge: Edge) -> tuple[int, int]:
        return self._ground.place[edge[0]], self._ground.place[edge[1]]
