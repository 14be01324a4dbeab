"""Undirected graphs of robots: named shapes, checked edge lists and matrices, distances, consensus weights.

Robots are named by strings and keep the order they are given in. An edge is a pair (a, b) with a before b in
that order, and edges are sorted by it, so two equal graphs compare equal.
"""

from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import combinations

from swarm.errors import LocalError

Edge = tuple[str, str]

MAX_RANDOM_DEGREE = 7
"""Links of one robot in a `random:` graph at most: what a Bluetooth Classic radio can hold."""

SHAPES = ("line", "loop", "full", "thesis-d", "random:SEED")
"""The shapes that `Graph.of_shape` takes."""

_THESIS_D = ((0, 1), (0, 3), (0, 4), (0, 5), (1, 2), (2, 3), (2, 5), (3, 4), (4, 5))
"""The irregular six-robot topology (d) of the thesis."""

_MASK = (1 << 64) - 1


def pair_of(a: str, b: str) -> Edge:
    """Return two robots in the order of their names: a link has the same pair in both directions."""
    return (a, b) if a < b else (b, a)


def hops_from(neighbours: Mapping[str, Collection[str]], start: str) -> dict[str, int]:
    """Hops from `start` to every node that it can reach, itself included, nearest first."""
    hops, todo = {start: 0}, deque((start,))
    while todo:
        here = todo.popleft()
        for other in neighbours.get(here, ()):
            if other not in hops:
                hops[other] = hops[here] + 1
                todo.append(other)
    return hops


class Graph:
    """An undirected graph without self-loops or double edges. Never changes after it was made."""

    def __init__(self, names: Sequence[str], edges: Sequence[Edge]) -> None:
        """`edges` in any order and direction; raises `LocalError` naming the edge that cannot be."""
        self.names = tuple(names)
        place = {name: i for i, name in enumerate(self.names)}
        if len(place) != len(self.names):
            raise LocalError("two robots have the same name")
        found: set[tuple[int, int]] = set()
        for a, b in edges:
            for name in (a, b):
                if name not in place:
                    raise LocalError(f"link {a}-{b}: there is no robot {name!r}")
            if a == b:
                raise LocalError(f"link {a}-{b}: a robot is not linked to itself")
            pair = (min(place[a], place[b]), max(place[a], place[b]))
            if pair in found:
                raise LocalError(f"link {a}-{b} is listed twice (a link holds both ways)")
            found.add(pair)
        self.edges: tuple[Edge, ...] = tuple((self.names[i], self.names[j]) for i, j in sorted(found))
        neighbours: dict[str, list[str]] = {name: [] for name in self.names}
        for a, b in self.edges:
            neighbours[a].append(b)
            neighbours[b].append(a)
        self._neighbours = {name: tuple(sorted(near)) for name, near in neighbours.items()}
        self._span: int | None = None

    @classmethod
    def of_shape(cls, shape: str, names: Sequence[str]) -> "Graph":
        """Return the named shape over `names`: one of `SHAPES`. Raises `LocalError` for an impossible one."""
        n = len(names)
        kind, colon, seed = shape.partition(":")
        if kind == "random" and colon:
            if not (seed.isascii() and seed.isdigit()) or int(seed[:20]) > _MASK or len(seed) > 20:
                raise LocalError(f"random:SEED needs a whole number from 0 to {_MASK}, got {shape[:40]!r}")
            pairs = _random_pairs(n, int(seed))
        elif shape == "line":
            pairs = [(i, i + 1) for i in range(n - 1)]
        elif shape == "loop":
            # Two robots in a loop have one link, not two parallel ones.
            pairs = [(i, i + 1) for i in range(n - 1)] + ([(0, n - 1)] if n > 2 else [])
        elif shape == "full":
            pairs = list(combinations(range(n), 2))
        elif shape == "thesis-d":
            if n != 6:
                raise LocalError(f"thesis-d is a graph of six robots, here are {n}")
            pairs = list(_THESIS_D)
        else:
            raise LocalError(f"expected {', '.join(SHAPES[:-1])} or {SHAPES[-1]}, got {shape[:40]!r}")
        return cls(names, [(names[i], names[j]) for i, j in pairs])

    @classmethod
    def of_matrix(cls, matrix: Sequence[Sequence[float]], names: Sequence[str]) -> "Graph":
        """Build a graph from an adjacency matrix of 0 and 1, rows in the order of `names`. Raises `LocalError`."""
        n = len(names)
        if len(matrix) != n:
            raise LocalError(f"expected {n} rows, one for each robot, got {len(matrix)}")
        for name, row in zip(names, matrix, strict=True):
            if len(row) != n:
                raise LocalError(f"row of {name}: expected {n} entries, one for each robot, got {len(row)}")
            for other, entry in zip(names, row, strict=True):
                if entry not in (0, 1):
                    raise LocalError(f"row of {name}, column of {other}: expected 0 or 1, got {entry}")
        for i, j in combinations(range(n), 2):
            if matrix[i][j] != matrix[j][i]:
                raise LocalError(
                    f"not symmetric: row of {names[i]}, column of {names[j]} is {matrix[i][j]:g}, "
                    f"the other way round it is {matrix[j][i]:g}"
                )
        for i, name in enumerate(names):
            if matrix[i][i]:
                raise LocalError(f"row of {name}: a robot is not linked to itself, its own entry must be 0")
        return cls(names, [(names[i], names[j]) for i, j in combinations(range(n), 2) if matrix[i][j]])

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Graph) and (self.names, self.edges) == (other.names, other.edges)

    def __hash__(self) -> int:
        return hash((self.names, self.edges))

    def __repr__(self) -> str:
        return f"Graph({self.names!r}, {self.edges!r})"

    def matrix(self) -> tuple[tuple[int, ...], ...]:
        """Return the adjacency matrix, rows in the order of `names`."""
        return tuple(tuple(int(b in self._neighbours[a]) for b in self.names) for a in self.names)

    def neighbours(self, name: str) -> tuple[str, ...]:
        """Return the names of the robots linked to `name`, sorted by name."""
        return self._neighbours[name]

    def degree(self, name: str) -> int:
        """Return the number of links of `name`."""
        return len(self._neighbours[name])

    def distances(self, name: str) -> dict[str, int]:
        """Hops from `name` to every robot it can reach, itself included, nearest first. Raises `KeyError` for a robot
        that there is not."""
        self.neighbours(name)  # raises where there is no such robot
        return hops_from(self._neighbours, name)

    def components(self) -> list[tuple[str, ...]]:
        """Return the connected parts, each in the order of `names`."""
        found: list[tuple[str, ...]] = []
        seen: set[str] = set()
        for name in self.names:
            if name not in seen:
                part = self.distances(name)
                seen.update(part)
                found.append(tuple(other for other in self.names if other in part))
        return found

    def is_connected(self) -> bool:
        """Return whether every robot reaches every other. A graph of one robot is; one of none is, too."""
        return not self.names or len(self.distances(self.names[0])) == len(self.names)

    def check_connected(self) -> None:
        """Raise `LocalError` with the parts where some robots cannot reach others."""
        if not self.is_connected():
            parts = "; ".join(" ".join(part[:8]) + (" ..." if len(part) > 8 else "") for part in self.components()[:8])
            raise LocalError(f"not connected: these parts cannot reach each other: {parts}")

    def diameter(self) -> int:
        """Hops between the robots farthest apart; raises `LocalError` where the graph is not connected."""
        if not self.is_connected():
            raise LocalError("the graph is not connected, it has no diameter")
        return max((max(self.distances(name).values()) for name in self.names), default=0)

    @property
    def span(self) -> int:
        """Return an upper bound of the diameter that is the same on every robot and needs one search: twice the
        distance from the first robot to the farthest one, and never more than that of a line."""
        if self._span is None:
            most = max(len(self.names) - 1, 0)
            reached = self.distances(self.names[0]) if self.names else {}
            self._span = min(2 * max(reached.values(), default=0), most) if len(reached) == len(self.names) else most
        return self._span

    def metropolis_weights(self, name: str) -> dict[str, float]:
        """w_ij = 1 / (1 + max(d_i, d_j)) by neighbour: symmetric, so consensus ends on the mean.

        The own weight is one minus their sum.
        """
        own = self.degree(name)
        return {other: 1.0 / (1 + max(own, self.degree(other))) for other in self.neighbours(name)}

    def row_weights(self, name: str) -> dict[str, float]:
        """w_ij = 1 / (1 + d_i) by neighbour (thesis rule 4.1): only on regular graphs a mean.

        The own weight is the same again.
        """
        return {other: 1.0 / (1 + self.degree(name)) for other in self.neighbours(name)}


def splitmix64(seed: int) -> Iterator[int]:
    """Endless 64-bit numbers from a seed (Steele, Lea, Flood 2014), the same on every machine."""
    state = seed & _MASK
    while True:
        state = (state + 0x9E3779B97F4A7C15) & _MASK
        z = state
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & _MASK
        yield z ^ (z >> 31)


def _random_pairs(n: int, seed: int) -> list[tuple[int, int]]:
    """Draw a random spanning tree over a random order, then about n/2 further links, none beyond the degree limit.

    A tree of i nodes has 2(i - 1) ends, fewer than 7 i, so there is always a node free to take the next one.
    """
    numbers = splitmix64(seed)
    order = list(range(n))
    for i in range(n - 1, 0, -1):
        j = next(numbers) % (i + 1)
        order[i], order[j] = order[j], order[i]
    degree = [0] * n
    pairs: set[tuple[int, int]] = set()

    def join(a: int, b: int) -> None:
        pairs.add((min(a, b), max(a, b)))
        degree[a] += 1
        degree[b] += 1

    free = order[:1]
    for new in order[1:]:
        i = next(numbers) % len(free)
        old = free[i]
        join(new, old)
        if degree[old] == MAX_RANDOM_DEGREE:
            free[i] = free[-1]
            free.pop()
        free.append(new)
    for _ in range(n // 2 if n > 2 else 0):
        a, b = next(numbers) % n, next(numbers) % n
        if a != b and (min(a, b), max(a, b)) not in pairs and max(degree[a], degree[b]) < MAX_RANDOM_DEGREE:
            join(a, b)
    return sorted(pairs)
