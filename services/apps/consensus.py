"""Average consensus: every robot ends on one value (thesis 4.3.1). docs/apps.md has the equations."""

from collections.abc import Mapping, Sequence
from typing import Any

from swarm import SyncApp
from swarm.codec import Value


class Consensus(SyncApp):
    """Metropolis weights (Xiao, Boyd, Lall 2005): every robot ends on the mean of the first values."""

    value: float

    def step(self, neighbours: Sequence[Any]) -> None:
        """x_i += sum_j w_ij (x_j - x_i)."""
        self.value += sum(w * (n.value - self.value) for w, n in self.weighted(neighbours))

    def result(self) -> Mapping[str, Value]:
        """The value, in the unit of the first values."""
        return {"value": self.value}


class Thesis(Consensus):
    """Rule 4.1: the mean of the own and the neighbours' values.

    On a graph that is not regular it ends on the mean weighted by d_i + 1, not on the mean.
    """

    weights = "row"


ALGORITHMS = {"metropolis": Consensus, "thesis": Thesis}
