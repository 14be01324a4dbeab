"""Lockstep as a discrete-event model: robots that compute in no time, over links that only take theirs.

The limit of what lockstep can do on links with jitter and cuts: a robot is at k + 1 when the last of its neighbours'
x(k) is there. The links are the simulator's own (`services.mesh.core.delay`): same distribution, same order. A cut
holds what arrives during it until it ends, as the simulated radio does. Pure: seeded, no clock, no IO.
"""

import heapq
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from services.mesh.core.delay import AirModel, DelayLine
from swarm.core.graph import Graph


@dataclass(frozen=True)
class Outage:
    """A link that passes nothing for a while."""

    link: tuple[str, str]
    """As the graph has it."""
    at: float
    """s after the first send."""
    seconds: float


def run(graph: Graph, air: AirModel, iterations: int, outages: Sequence[Outage] = ()) -> dict[str, dict[int, float]]:
    """When each robot is at each iteration, s; all start at 0."""
    cuts: dict[tuple[str, str], list[Outage]] = {}
    for outage in outages:
        a, b = outage.link
        for way in ((a, b), (b, a)):
            cuts.setdefault(way, []).append(outage)
    lines = {
        (sender, receiver): DelayLine(air, random.Random(f"{air.seed}:{sender}>{receiver}"))
        for receiver in graph.names
        for sender in graph.neighbours(receiver)
    }
    last = dict.fromkeys(lines, 0.0)
    times: dict[str, dict[int, float]] = {name: {0: 0.0} for name in graph.names}
    heard: dict[tuple[str, int], int] = {}
    events: list[tuple[float, str, int]] = []

    def send(name: str, k: int, now: float) -> None:
        for peer in graph.neighbours(name):
            way = (name, peer)
            lines[way].push(b"x", now)
            arrival = lines[way].next_arrival() or 0.0
            lines[way].pop()
            last[way] = max(last[way], _after_cuts(arrival, cuts.get(way, ())))
            heapq.heappush(events, (last[way], peer, k))

    for name in graph.names:
        send(name, 0, 0.0)
    while events:
        now, name, k = heapq.heappop(events)
        heard[name, k] = heard.get((name, k), 0) + 1
        at = max(times[name])
        # The slots of the iteration after may have been full before this one's.
        while at < iterations and heard.get((name, at), 0) == len(graph.neighbours(name)):
            del heard[name, at]
            at += 1
            times[name][at] = now
            if at < iterations:
                send(name, at, now)
    return times


def _after_cuts(arrival: float, cuts: Sequence[Outage]) -> float:
    for cut in sorted(cuts, key=lambda cut: cut.at):
        if cut.at <= arrival < cut.at + cut.seconds:
            arrival = cut.at + cut.seconds
    return arrival


def mean_iteration(times: Mapping[str, Mapping[int, float]], first: int = 0) -> float:
    """s an iteration, from iteration `first` to the end, over all robots."""
    spans = [(path[max(path)] - path[first]) / (max(path) - first) for path in times.values()]
    return sum(spans) / len(spans)
