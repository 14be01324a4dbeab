"""The automatic topology: from what links there are and who hears whom, which ones there should be.

A link that works stays: the plan only adds what is lacking, and takes away what is clearly too much, in five steps,
none of which undoes another's work. So the same swarm has the same plan, and the plan of a plan is the plan itself.

connect  join parts by links between robots with few of them: Kruskal's forest grown by degree, links that are up first.
         Where a robot is full, one of its links gives way to another between others: the exchange of Fürer and
         Raghavachari (1994), whose trees of least degree are within one of the best there are.
relieve  a robot with all its seven links gives up one that others can replace, so that it can let in who comes.
double   no robot is the only one between two parts, wherever ears allow it (Eswaran and Tarjan 1976: biconnectivity
         augmentation; here by the farthest pair, so that a line becomes a loop).
shorten  while some are farther apart than the binary logarithm of their number, the farthest pair with few links gets
         one: few long chords make the world small (Watts and Strogatz 1998).
prune    of links between two robots that both have more than they need those go that neither of this takes.

Links with a robot that is away stay as far as there is room: who comes back finds its links.
"""

import heapq
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import lru_cache

from services.mesh.core.routing.link_state import LinkStateMap
from services.mesh.core.routing.topology import MAX_LINKS, Ground, TopologyVersion
from swarm.core.graph import Edge

SOCIABLE = 4
"""Links a robot has at most for the sake of short ways; as many are enough for a logarithmic diameter."""

DOUBLED = MAX_LINKS - 1
"""Links a robot has at most for the sake of a second way: the last one is for who comes."""

SETTLE = 1.0
"""Seconds of news that the automatic rule waits for, and between two changes of it."""

FORGET = 60.0
"""Seconds after which the automatic rule takes a link between two robots that do not hear each other out of the
topology."""

Pair = tuple[int, int]


class _Graph:
    """Links between the members, by place."""

    def __init__(self, members: Iterable[int], pairs: Iterable[Pair] = ()) -> None:
        self.near: dict[int, set[int]] = {member: set() for member in sorted(members)}
        for a, b in pairs:
            self.add(a, b)

    def add(self, a: int, b: int) -> None:
        self.near[a].add(b)
        self.near[b].add(a)

    def remove(self, a: int, b: int) -> None:
        self.near[a].discard(b)
        self.near[b].discard(a)

    def degree(self, a: int) -> int:
        return len(self.near[a])

    def fits(self, pair: Pair, most: int = MAX_LINKS) -> bool:
        """Return whether a link that is not there may be added."""
        a, b = pair
        return b not in self.near[a] and len(self.near[a]) < most and len(self.near[b]) < most

    def pairs(self) -> list[Pair]:
        return [(a, b) for a in self.near for b in sorted(self.near[a]) if a < b]

    def distances(self, start: int, without: int = -1) -> dict[int, int]:
        """Hops to all who can be reached, without one robot."""
        found, ring = {start: 0}, [start]
        while ring:
            outer = []
            for here in ring:
                for other in self.near[here]:
                    if other != without and other not in found:
                        found[other] = found[here] + 1
                        outer.append(other)
            ring = outer
        return found

    def parts(self, without: int = -1) -> list[set[int]]:
        """Return the parts, without one robot."""
        found: list[set[int]] = []
        left = dict.fromkeys(member for member in self.near if member != without)
        while left:
            part = set(self.distances(next(iter(left)), without))
            found.append(part)
            for member in part:
                del left[member]
        return found

    def diameter(self) -> int:
        """Hops between the two members of one part that are farthest apart."""
        return max((max(self.distances(member).values()) for member in self.near), default=0)


def plan(
    names: Sequence[str],
    members: Collection[str],
    edges: Collection[Edge],
    heard: Collection[Edge],
    up: Collection[Edge],
) -> tuple[Edge, ...]:
    """Return the links there should be, in the order of `names`.

    `members` are the robots in reach, `edges` the links there should have been so far, `heard` those that can be made
    between members, `up` those of them that are up.
    """
    place = {name: index for index, name in enumerate(names)}

    def pairs(of: Iterable[Edge]) -> list[Pair]:
        return sorted((min(place[a], place[b]), max(place[a], place[b])) for a, b in of)

    inside = {place[name] for name in members}
    can, is_up, before = pairs(heard), set(pairs(up)), pairs(edges)
    possible = set(can)
    graph = _Graph(inside)
    for pair in before:
        if pair in possible and graph.fits(pair):
            graph.add(*pair)
    _connect(graph, can, is_up)
    if len(graph.parts()) > 1:
        # What is up has room, and may hold together what could not be joined.
        fallback = _Graph(inside, is_up)
        if len(fallback.parts()) < len(graph.parts()) and all(
            len(near) <= MAX_LINKS for near in fallback.near.values()
        ):
            graph = fallback
    for member in graph.near:
        if graph.degree(member) >= MAX_LINKS:
            _free(graph, member, can, DOUBLED)
    _double(graph, can)
    _shorten(graph, can)
    _prune(graph)
    whole = _Graph(range(len(names)), graph.pairs())
    for pair in before:
        if pair not in possible and whole.fits(pair):
            whole.add(*pair)
    return tuple((names[a], names[b]) for a, b in whole.pairs())


def _connect(graph: _Graph, can: Sequence[Pair], up: Collection[Pair]) -> None:
    """Join the parts as far as that can be done."""
    part_of = {member: index for index, part in enumerate(graph.parts()) for member in part}
    members = {index: set(part) for index, part in enumerate(graph.parts())}

    def cost(pair: Pair) -> tuple[bool, int, int]:
        degrees = graph.degree(pair[0]), graph.degree(pair[1])
        return pair not in up, max(degrees), sum(degrees)

    def join(pair: Pair) -> None:
        graph.add(*pair)
        keep, gone = part_of[pair[0]], part_of[pair[1]]
        for member in members[gone]:
            part_of[member] = keep
        members[keep] |= members.pop(gone)

    heap = [(cost(pair), pair) for pair in can if part_of[pair[0]] != part_of[pair[1]]]
    heapq.heapify(heap)
    full: list[Pair] = []
    while heap:
        known, pair = heapq.heappop(heap)
        if part_of[pair[0]] == part_of[pair[1]]:
            continue
        if not graph.fits(pair):
            full.append(pair)
        elif known != (now := cost(pair)):
            heapq.heappush(heap, (now, pair))  # degrees only grow: it is not before its turn
        else:
            join(pair)
    for pair in full:
        if part_of[pair[0]] != part_of[pair[1]] and all(
            graph.degree(end) < MAX_LINKS or _free(graph, end, can, MAX_LINKS) for end in pair
        ):
            join(pair)


def _free(graph: _Graph, robot: int, can: Sequence[Pair], most: int) -> bool:
    """Take a link from a robot without taking a part from the graph; False where that cannot be."""
    near = sorted(graph.near[robot], key=lambda other: (-graph.degree(other), other))
    for other in near:
        graph.remove(robot, other)
        here = graph.distances(robot)
        if other in here:
            return True
        there = graph.distances(other)
        for pair in can:
            across = (pair[0] in here and pair[1] in there) or (pair[1] in here and pair[0] in there)
            if across and robot not in pair and graph.fits(pair, most):
                graph.add(*pair)
                return True
        graph.add(robot, other)
    return False


def _double(graph: _Graph, can: Sequence[Pair]) -> None:
    """Give every two parts that one robot holds together a second way."""
    for robot in graph.near:
        while (parts := graph.parts(robot)) and len(parts) > 1:
            part_of = {member: index for index, part in enumerate(parts) for member in part}
            whole = graph.distances(robot)
            pairs = [
                pair
                for pair in can
                if robot not in pair
                and pair[0] in whole
                and pair[1] in whole
                and part_of[pair[0]] != part_of[pair[1]]
                and graph.fits(pair, DOUBLED)
            ]
            if not pairs:
                break
            graph.add(*_farthest(graph, pairs)[1])


def _shorten(graph: _Graph, can: Sequence[Pair]) -> None:
    """Link those who are farthest apart, until nobody is far from anybody."""
    bound = _bound(graph)
    while graph.diameter() > bound:
        pairs = [pair for pair in can if graph.fits(pair, SOCIABLE)]
        if not pairs or (best := _farthest(graph, pairs))[0] < 3:
            return
        graph.add(*best[1])


def _prune(graph: _Graph) -> None:
    """Take away what is neither needed for a second way nor for a short one."""
    most = max(_bound(graph), graph.diameter())
    for a, b in sorted(graph.pairs(), key=lambda pair: (-graph.degree(pair[0]) - graph.degree(pair[1]), pair)):
        if min(graph.degree(a), graph.degree(b)) <= SOCIABLE:
            continue
        parts = {member: len(graph.parts(member)) for member in (-1, *graph.near)}
        graph.remove(a, b)
        if any(len(graph.parts(member)) > count for member, count in parts.items()) or graph.diameter() > most:
            graph.add(a, b)


def _bound(graph: _Graph) -> int:
    """Hops that nobody should be apart: the binary logarithm of the number of robots."""
    return max(2, (len(graph.near) - 1).bit_length())


def _farthest(graph: _Graph, pairs: Sequence[Pair]) -> tuple[int, Pair]:
    """Return the pair that is farthest apart, of several that with the fewest links."""
    distances = {start: graph.distances(start) for start in {pair[0] for pair in pairs}}

    def merit(pair: Pair) -> tuple[int, int, int, int]:
        distance = distances[pair[0]].get(pair[1], 0)
        return distance, -graph.degree(pair[0]) - graph.degree(pair[1]), -pair[0], -pair[1]

    best = max(pairs, key=merit)
    return merit(best)[0], best


@lru_cache(maxsize=1)
def place_of(names: tuple[str, ...]) -> Mapping[str, int]:
    """Return the place of each name; of the robots of a simulation the same table for all."""
    return {name: place for place, name in enumerate(names)}


def places(bits: int, count: int) -> list[int]:
    """Return the places below `count` whose bit is set. A peer may have set others."""
    return [place for place in range(count) if bits >> place & 1]


class AutomaticRule:
    """The rule by which the robot with the lowest place mends the topology. Calls with `now` must not go back in
    time."""

    def __init__(self, me: str, ground: Ground, map: LinkStateMap) -> None:
        self._me = me
        self._ground = ground
        self._map = map
        self._dead: dict[Edge, float] = {}
        """Links of the topology between robots in reach that do not hear each other, and since when."""

    def mend(self, value: TopologyVersion, now: float, *, agreed: bool) -> tuple[tuple[Edge, ...], float]:
        """Return the links that there are to be in place of those of `value`, and when to look again.

        `agreed`: whether all robots in reach have `value`, or were waited for.
        """
        members = {self._me, *self._map.routes()}
        if not value.auto or min(members, key=self._ground.place.__getitem__) != self._me:
            self._dead.clear()
            return value.edges, float("inf")
        if not agreed:
            return value.edges, now + SETTLE
        names, edge, edges = self._ground.names, self._ground.edge, value.edges
        up = {edge(a, b) for a, near in self._map.graph().items() for b in near if a in members and b in members}
        heard = set(up)
        for name in members:
            reached = places(self._map.heard(name), len(names))
            heard |= {edge(name, names[place]) for place in reached if names[place] in members and names[place] != name}
        silent = {each for each in edges if each[0] in members and each[1] in members and each not in heard}
        self._dead = {each: self._dead.get(each, now) for each in silent}
        dead = {each for each, since in self._dead.items() if now >= since + FORGET}
        look_at = min((since + FORGET for each, since in self._dead.items() if each not in dead), default=float("inf"))
        return plan(names, members, [each for each in edges if each not in dead], heard, up), look_at
