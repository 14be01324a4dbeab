"""Average consensus: every robot ends on one value (thesis 4.3.1).

See docs/reference/apps/consensus.md.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from swarm import SyncApp, Vector
from swarm.core import spectrum
from swarm.errors import AppError
from swarm.messages.codec import Value

ROOM = 53
"""Robots that `flood` has room for: a value of 8 bytes each, in a state of at most 440."""


class Consensus(SyncApp):
    """Metropolis weights (Xiao, Boyd, Lall 2005): every robot ends on the mean of the first values."""

    value: float

    def step(self, neighbours: Sequence[Any]) -> None:
        """x_i += sum_j w_ij (x_j - x_i)."""
        self.value += math.fsum(w * (n.value - self.value) for w, n in self.weighted(neighbours))

    def result(self) -> Mapping[str, Value]:
        """Return the value, in the unit of the first values."""
        return {"value": self.value}


class ThesisConsensus(Consensus):
    """Rule 4.1: the mean of the own and the neighbours' values.

    On a graph that is not regular it ends on the mean weighted by d_i + 1, not on the mean.
    """

    weights = "row"


class SecondOrder(Consensus):
    """Metropolis with a memory of one step, tuned to the graph (Muthukrishnan, Ghosh, Schultz 1998).

    The errors of two steps are combined so that they cancel: x(k+1) = omega W x(k) + (1 - omega) x(k-1).
    """

    _before: float = 0.0
    """x(k-1)."""
    _omega: float = 1.0
    """The weight omega of the last step."""
    _gain: float = 1.0
    """The gain of the plain step within the combination."""
    _radius: float = 0.0
    """Largest factor by which one plain step can leave disagreement."""
    _begun: int = 0
    """The iteration at which it began: 0, or that at which members or links have changed."""

    def start(self) -> None:
        """Every robot knows the graph, and so the eigenvalues of its weights."""
        if self.weights != "metropolis":
            raise AppError(f"weights = {self.weights!r}: this algorithm is tuned to symmetric weights, leave them out")
        low, high = spectrum.bounds(self.robot.graph, self.robot.name)
        self._tune(low, high)

    def on_epoch(self, members: Sequence[str]) -> None:
        """Begin anew from where it is: a step that remembers other members would carry their values on."""
        self._begun, self._before, self._omega = self.k, self.value, 1.0
        self.start()

    def step(self, neighbours: Sequence[Any]) -> None:
        """x(k+1) = x(k-1) + omega (x(k) - x(k-1) + gain sum_j w_ij (x_j - x_i)); the first step is a plain one."""
        if self.k > self._begun:
            self._omega = self._next()
        pull = self._gain * math.fsum(w * (n.value - self.value) for w, n in self.weighted(neighbours))
        self.value, self._before = self._before + self._omega * (self.value - self._before + pull), self.value

    def _tune(self, low: float, high: float) -> None:
        """`low` and `high`: the eigenvalues of the weights farthest from agreement's."""
        self._radius = max(-low, high)

    def _next(self) -> float:
        return 2.0 / (1.0 + math.sqrt(1.0 - self._radius * self._radius))


class Chebyshev(SecondOrder):
    """The second-order method with the best omega for each k, from Chebyshev's polynomials (Golub, Varga 1961)."""

    def _tune(self, low: float, high: float) -> None:
        self._gain = 2.0 / (2.0 - high - low)
        self._radius = (high - low) / (2.0 - high - low)

    def _next(self) -> float:
        if self.k == self._begun + 1:
            return 1.0 / (1.0 - self._radius * self._radius / 2.0)
        return 1.0 / (1.0 - self._radius * self._radius * self._omega / 4.0)


class FloodConsensus(SyncApp):
    """Every robot passes on all the first values it knows and takes their mean: exact after as many rounds as hops."""

    value: float
    """Mean of the values known so far; before the first step, the own one."""
    known: int
    """Bit i: the value of the i-th robot of the swarm is there."""
    values: Annotated[Vector, ROOM]
    """First values, in the order of the swarm."""
    _order: tuple[str, ...] = ()
    """The order of the robots in `values`."""

    def start(self) -> None:
        """Begin with the own value as the only one that is known."""
        swarm = self.robot.swarm
        if len(swarm) > ROOM:
            raise AppError(f"flood has room for {ROOM} robots, the swarm has {len(swarm)}: take another algorithm")
        own = swarm.index(self.robot.name)
        self._order = swarm
        self.known = 1 << own
        self.values = tuple([self.value if i == own else 0.0 for i in range(ROOM)])

    def on_epoch(self, members: Sequence[str]) -> None:
        """Forget who is no member; keep the others' values, in the new order."""
        values = {self._order[i]: self.values[i] for i in _bits(self.known)}
        self._order = tuple(members)
        self.known = sum(1 << i for i, name in enumerate(members) if name in values)
        self.values = tuple([values.get(name, 0.0) for name in (*members, *[""] * (ROOM - len(members)))])
        there = [values[name] for name in members if name in values]
        self.value = math.fsum(there) / len(there)

    def step(self, neighbours: Sequence[Any]) -> None:
        """Take over what the neighbours know."""
        values = list(self.values)
        for n in neighbours:
            for i in _bits(n.known & ~self.known):
                values[i] = n.values[i]
            self.known |= n.known
        self.values = tuple(values)
        there = [values[i] for i in _bits(self.known)]
        self.value = math.fsum(there) / len(there)

    def result(self) -> Mapping[str, Value]:
        """Return the mean of the known values, and how many they are."""
        return {"value": self.value, "known": self.known.bit_count()}


def _bits(number: int) -> list[int]:
    return [i for i in range(ROOM) if number >> i & 1]


ALGORITHMS = {
    "metropolis": Consensus,
    "thesis": ThesisConsensus,
    "second_order": SecondOrder,
    "chebyshev": Chebyshev,
    "flood": FloodConsensus,
}
