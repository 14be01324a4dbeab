"""An app for the bench of faults: its values never settle, so that every iteration can be told from every other."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from swarm import SyncApp, parameter

TURN = 0.37
"""rad a step."""


class Restless(SyncApp):
    """A consensus that every robot is pushed out of by a swing of its own."""

    value: float
    _n: int = 0
    phase: float = parameter(0.0, unit="rad")

    def step(self, neighbours: Sequence[Any]) -> None:
        """x_i += sum_j w_ij (x_j - x_i) + sin(0.37 n + phase)."""
        self.value += math.fsum(w * (n.value - self.value) for w, n in self.weighted(neighbours))
        self.value += math.sin(TURN * self._n + self.phase)
        self._n += 1

    def result(self) -> Mapping[str, int]:
        """The steps that it has done itself: what it keeps to itself, for whoever compares."""
        return {"n": self._n}
