"""Shortest paths (Dijkstra 1959; with hops as metric it is the thesis' breadth-first search, algorithm 2)."""

import heapq
from collections.abc import Mapping
from typing import NamedTuple


class Route(NamedTuple):
    """The way from this robot to another one."""

    next_hop: str
    hops: int
    cost: int
    """Sum of the edges' metric."""
    time: int
    """Sum of the edges' one-way times, units of 0.1 ms."""


class Edge(NamedTuple):
    """One direction of a link."""

    cost: int
    time: int


def routes(me: str, graph: Mapping[str, Mapping[str, Edge]]) -> dict[str, Route]:
    """The best route to every robot that can be reached; `graph[a][b]` is the edge from a to b.

    Of ways that cost the same the one with fewer hops wins, then the one whose first robot has the lower name: the
    same graph gives the same routes everywhere and every time.
    """
    found: dict[str, Route] = {}
    # Every name at most once for each edge that leads to it.
    heap = [(edge.cost, 1, peer, peer, edge.time) for peer, edge in graph.get(me, {}).items()]
    heapq.heapify(heap)
    while heap:
        cost, hops, first, name, time = heapq.heappop(heap)
        if name in found or name == me:
            continue
        found[name] = Route(first, hops, cost, time)
        for peer, edge in graph.get(name, {}).items():
            if peer not in found and peer != me:
                heapq.heappush(heap, (cost + edge.cost, hops + 1, first, peer, time + edge.time))
    return found


def routes_by_hops(me: str, own: Mapping[str, int], told: Mapping[str, Mapping[str, int]]) -> dict[str, Route]:
    """The same where every edge costs 1, level by level. `own`: times of this robot's edges; `told[a][b]`: the time
    that a tells of its edge to b, which counts where b tells of it, too."""
    found: dict[str, Route] = {}
    nothing: Mapping[str, int] = {}
    level = {peer: (peer, time) for peer, time in own.items()}
    hops = 0
    while level:
        hops += 1
        # In the order in which `routes` finds them.
        for first, name, time in sorted([(first, name, time) for name, (first, time) in level.items()]):
            found[name] = Route(first, hops, hops, time)
        further: dict[str, tuple[str, int]] = {}
        for name, (first, time) in level.items():
            for peer, there in told.get(name, nothing).items():
                if peer in found or peer == me:
                    continue
                back = told.get(peer, nothing).get(name)
                if back is None:
                    continue
                way = (first, time + (there if there > back else back))
                best = further.get(peer)
                if best is None or way < best:
                    further[peer] = way
        level = further
    return found
