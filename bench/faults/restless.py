"""An app for the bench of faults: its values never settle, so that every iteration can be told from every other."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from swarm import SyncApp, parameter

TURN = 0.37
"""Of the swing's four, a step."""


def swing(n: int, phase: float) -> float:
    """From 0 to 1, to -1 and back in a period of 4, in straight lines: a sine is the C library's, and may differ in its
    last bit from one kind of processor to another."""
    return 1.0 - abs((TURN * n + phase + 1.0) % 4.0 - 2.0)


class Restless(SyncApp):
    """A consensus that every robot is pushed out of by a swing of its own."""

    value: float
    _n: int = 0
    phase: float = parameter(0.0)

    def step(self, neighbours: Sequence[Any]) -> None:
        """x_i += sum_j w_ij (x_j - x_i) + swing(n, phase)."""
        self.value += math.fsum(w * (n.value - self.value) for w, n in self.weighted(neighbours))
        self.value += swing(self._n, self.phase)
        self._n += 1

    def result(self) -> Mapping[str, int]:
        """The steps that it has done itself: what it keeps to itself, for whoever compares."""
        return {"n": self._n}
