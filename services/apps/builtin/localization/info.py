"""`info`: consensus on the sums of the squared-range problem, solved in closed form by every robot. No step size."""

from collections.abc import Mapping, Sequence
from math import fsum
from typing import Annotated, Any

from services.apps.builtin.localization import ranges
from services.apps.builtin.localization.place import Localization
from swarm import Vector, parameter
from swarm.messages.codec import Value


class Info(Localization):
    """q_i follows the mean over all robots of their statistics m_i by dynamic average consensus (Zhu, Martinez 2010).

    q_i += sum_j w_ij (q_j - q_i) + m_i(k+1) - m_i(k). The sum of all q stays that of all m, whatever the ranges do.
    """

    q: Annotated[Vector, 9]
    """Statistics about the mean of the anchors as origin: far from it their differences would be lost in
    rounding."""
    _m: ranges.Statistics = ranges.NOTHING

    smoothing: float = parameter(0.1, unit="1", low=0.001, high=1)
    """Share of a new measurement in the own statistics: 1 takes the newest alone."""

    def start(self) -> None:
        """The first measurement is the first opinion."""
        self._m = self.q = self.statistics()

    def on_epoch(self, members: Sequence[str]) -> None:
        """Agree anew: the sum of all q is to be that of the members' statistics, not of those who left."""
        self.q = self._m

    def step(self, neighbours: Sequence[Any]) -> None:
        """Compute one round of dynamic average consensus."""
        new, beta = self.statistics(), self.smoothing
        m = tuple([old + beta * (now - old) for old, now in zip(self._m, new, strict=True)])
        weighted = self.weighted(neighbours)
        # The difference to each neighbour is formed first, of values as they are sent, the own one too: both ends of an
        # edge then add the same amount with opposite signs, and the sum over the swarm stays.
        self.q = tuple(
            own + fsum(w * (n.q[i] - own) for w, n in weighted) + (m[i] - self._m[i]) for i, own in enumerate(self.q)
        )
        self._m = m

    def result(self) -> Mapping[str, Value]:
        """Place of the target, m, its uncertainty, and the other place that fits as well (the same one if none)."""
        found = self.found(self.q, self._m)
        return self.report((found.x, found.y), found)
