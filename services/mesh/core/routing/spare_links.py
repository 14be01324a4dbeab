"""The links of a robot that the topology in force does not contain: which of them are not needed any more."""

from collections.abc import Iterable, Mapping, Set

from services.mesh.core.routing.topology import Ground
from swarm.core.graph import Edge

GRACE = 1.0
"""Seconds for which the other way must have been there: what is being flooded has passed, routes have been told."""


class SpareLinks:
    """The spare links of one robot. Calls with `now` must not go back in time."""

    def __init__(self, me: str, ground: Ground) -> None:
        self._me = me
        self._ground = ground
        self._since: dict[str, float] = {}
        """Unwanted links that are not needed any more, and since when."""

    def lost(self, peer: str) -> None:
        """Forget a link that is gone."""
        self._since.pop(peer, None)

    def forget(self) -> None:
        """Begin anew: another topology is in force."""
        self._since.clear()

    def needless(
        self, kept: Iterable[str], graph: Mapping[str, Mapping[str, object]], topology: Set[Edge], now: float
    ) -> tuple[list[str], float]:
        """Return which of the links `kept` can go, and when to look again.

        `graph` has the links of all robots in reach; without any, all links are kept. `topology` has its own links.
        """
        found, look_at = [], float("inf")
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
