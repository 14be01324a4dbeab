"""Lockstep as a discrete-event model: robots that compute in no time, over links that only take theirs.

The limit of what lockstep can do on links with jitter and cuts: a robot is at k + 1 when the last of its neighbours'
x(k) is there. The links are the simulator's own (`services.mesh.links.radio_model`): same distribution, same order. A
cut holds what arrives during it until it ends, as the simulated radio does. Pure: seeded, no clock, no IO.
"""

import heapq
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from services.mesh.core.routing.topology import Weight, routes
from services.mesh.links.radio_model import AirModel, DelayLine
from swarm.core.graph import Graph

Way = tuple[str, str]
"""From one robot to its neighbour."""


@dataclass(frozen=True)
class Outage:
    """A link that passes nothing for a while."""

    link: tuple[str, str]
    """As the graph has it."""
    at: float
    """s after the first send."""
    seconds: float


def run(
    graph: Graph,
    air: AirModel,
    iterations: int,
    outages: Sequence[Outage] = (),
    *,
    around_after: float | None = None,
) -> dict[str, dict[int, float]]:
    """When each robot is at each iteration, s; all start at 0. `around_after`: who has lacked a value for so long knows
    which of its links are cut, and what it says to those neighbours goes around the link, too, until that speaks."""
    return _Run(graph, air, iterations, outages, around_after).times


class _Run:
    """From the first value to the last. A value comes with the one before, so of a neighbour the newest counts."""

    def __init__(
        self, graph: Graph, air: AirModel, iterations: int, outages: Sequence[Outage], around_after: float | None
    ) -> None:
        self.times: dict[str, dict[int, float]] = {name: {0: 0.0} for name in graph.names}
        self._graph, self._iterations, self._around_after = graph, iterations, around_after
        self._cuts: dict[Way, list[Outage]] = {}
        for outage in sorted(outages, key=lambda outage: outage.at):
            for way in (outage.link, outage.link[::-1]):
                self._cuts.setdefault(way, []).append(outage)
        self._lines = {
            (sender, receiver): DelayLine(air, random.Random(f"{air.seed}:{sender}>{receiver}"))
            for receiver in graph.names
            for sender in graph.neighbours(receiver)
        }
        self._last = dict.fromkeys(self._lines, 0.0)
        self._heard = dict.fromkeys(self._lines, -1)
        """The newest iteration that each robot has of each neighbour, by the way from that one."""
        self._around: set[Way] = set()
        self._events: list[tuple[float, int, Callable[[float], None]]] = []
        self._count = 0
        for name in graph.names:
            self._send(name, 0, 0.0)
        while self._events:
            now, _, happen = heapq.heappop(self._events)
            happen(now)

    def _at(self, when: float, happen: Callable[[float], None]) -> None:
        self._count += 1
        heapq.heappush(self._events, (when, self._count, happen))

    def _send(self, name: str, k: int, now: float) -> None:
        for peer in self._graph.neighbours(name):
            self._pass((name, peer), now, lambda at, way=(name, peer): self._speaks(way, k, at))  # type: ignore[misc]
            if (name, peer) in self._around:
                self._go_around(name, peer, k, now)
        if self._around_after is not None:
            self._at(now + self._around_after, lambda at: self._look(name, k, at))

    def _pass(self, way: Way, now: float, arrive: Callable[[float], None]) -> None:
        self._lines[way].push(b"x", now)
        arrival = self._lines[way].next_arrival() or 0.0
        self._lines[way].pop()
        for cut in self._cuts.get(way, ()):
            if cut.at <= arrival < cut.at + cut.seconds:
                arrival = cut.at + cut.seconds
        self._last[way] = max(self._last[way], arrival)
        self._at(self._last[way], arrive)

    def _speaks(self, way: Way, k: int, now: float) -> None:
        """Something has come over a link."""
        self._around.discard(way[::-1])
        self._arrive(way, k, now)

    def _arrive(self, way: Way, k: int, now: float) -> None:
        self._heard[way] = max(self._heard[way], k)
        name = way[1]
        at = max(self.times[name])
        while at < self._iterations and all(self._heard[peer, name] >= at for peer in self._graph.neighbours(name)):
            at += 1
            self.times[name][at] = now
            if at < self._iterations:
                self._send(name, at, now)

    def _look(self, name: str, k: int, now: float) -> None:
        """Whether iteration k still waits for somebody behind a cut."""
        if max(self.times[name]) > k:
            return
        for peer in self._graph.neighbours(name):
            cuts = self._cuts.get((name, peer), ())
            cut = any(cut.at <= now < cut.at + cut.seconds for cut in cuts)
            if cut and self._heard[peer, name] < k and (name, peer) not in self._around:
                self._around.add((name, peer))
                self._go_around(name, peer, k, now)

    def _go_around(self, name: str, to: str, k: int, now: float) -> None:
        """Along the shortest way without the link."""
        edges = {
            a: {b: Weight(1, 0) for b in self._graph.neighbours(a) if {a, b} != {name, to}} for a in self._graph.names
        }

        def pass_on(here: str, now: float) -> None:
            if here == to:
                self._arrive((name, to), k, now)
            elif (route := routes(here, edges).get(to)) is not None:
                self._pass((here, route.next_hop), now, lambda then: pass_on(route.next_hop, then))

        pass_on(name, now)


def mean_iteration(times: Mapping[str, Mapping[int, float]], first: int = 0) -> float:
    """s an iteration, from iteration `first` to the end, over all robots."""
    spans = [(path[max(path)] - path[first]) / (max(path) - first) for path in times.values()]
    return sum(spans) / len(spans)
