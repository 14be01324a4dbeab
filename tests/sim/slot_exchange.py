"""The delay model of lockstep on the slot radio: each value is a frame over each link on its way, and robots scan for
pages. Nothing else takes the radio's time."""

from collections.abc import Sequence
from functools import partial

from bench.radio.patterns import HEAD, VALUE, Pattern, neighbours
from sim.slots.calls import Calls
from sim.slots.parameters import SlotParameters
from swarm.core.graph import Edge

Tree = dict[str, tuple[str, ...]]
"""The robots to which each robot passes a value on."""


def way_of(origin: str, goals: Sequence[str], links: Sequence[Edge]) -> Tree:
    """Return how a value comes from its origin to its neighbours over the shortest ways."""
    near, before, todo = neighbours(links), {origin: ""}, [origin]
    for here in todo:
        for other in near[here]:
            if other not in before:
                before[other] = here
                todo.append(other)
    on_way = set(goals)
    for here in reversed(todo):
        if here in on_way and before[here]:
            on_way.add(before[here])
    return {here: tuple(other for other in todo if other in on_way and before[other] == here) for here in todo}


def ways_of(edges: Sequence[Edge], links: Sequence[Edge]) -> dict[str, Tree]:
    """Return the way of each robot's value to its neighbours in the topology `edges`."""
    return {name: way_of(name, near, links) for name, near in neighbours(edges).items()}


def frames_of(edges: Sequence[Edge], links: Sequence[Edge]) -> int:
    """Return how many frames an iteration needs."""
    return sum(len(others) for way in ways_of(edges, links).values() for others in way.values())


class Exchange(Pattern):
    """Robots that compute as soon as all neighbours' values are there."""

    def __init__(self, edges: Sequence[Edge], links: Sequence[Edge], parameters: SlotParameters, seed: int) -> None:
        """The first robot of each link is its central."""
        super().__init__(links, parameters, seed)
        Calls(self.time, self.radio).reachable.update(self.names)
        self._near, self._ways = neighbours(edges), ways_of(edges, links)
        self._heard = {(name, peer): -1 for name, near in self._near.items() for peer in near}
        """The newest iteration of a neighbour's values."""
        for name in self.names:
            self.after(0.3 * self.random.random(), partial(self._begin, name))

    def _begin(self, name: str) -> None:
        self.times[name].append(self.time.now)
        self._pass_on(name, name, len(self.times[name]) - 1)
        self._settle(name)

    def _pass_on(self, here: str, origin: str, k: int) -> None:
        for other in self._ways[origin][here]:
            self.say(here, other, HEAD + VALUE, partial(self._arrive, other, origin, k))

    def _arrive(self, here: str, origin: str, k: int) -> None:
        if (here, origin) in self._heard:
            self._heard[here, origin] = k
        self._pass_on(here, origin, k)
        if (here, origin) in self._heard:
            self._settle(here)

    def _settle(self, name: str) -> None:
        k = len(self.times[name]) - 1
        if k >= 0 and all(self._heard[name, peer] >= k for peer in self._near[name]):
            self.after(0.0, partial(self._go_on, name, k))

    def _go_on(self, name: str, k: int) -> None:
        if len(self.times[name]) == k + 1:
            self._begin(name)
