"""An app for measurements: coupled logistic maps, which never settle.

One value lost, doubled or out of turn changes every later one of the whole swarm, and no rounding hides it. (Consensus
would: on the full graph it is constant after one step.)
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from swarm import SyncApp, parameter
from swarm.messages.codec import Value


class Lattice(SyncApp):
    """x_i <- (1 - c) f(x_i) + c mean f(x_j), f(x) = r x (1 - x)  (Kaneko 1984)."""

    value: float
    coupling: float = parameter(0.2, low=0.0, high=1.0)
    rate: float = parameter(3.9, low=0.0, high=4.0)

    def start(self) -> None:
        """Robots begin apart: the app's generator is seeded with the robot's name."""
        self.value = self.robot.random.uniform(0.2, 0.8)

    def step(self, neighbours: Sequence[Any]) -> None:
        """One iteration of the map."""
        near = math.fsum(self._map(n.value) for n in neighbours) / len(neighbours)
        self.value = (1.0 - self.coupling) * self._map(self.value) + self.coupling * near

    def result(self) -> Mapping[str, Value]:
        """The value."""
        return {"value": self.value}

    def _map(self, x: float) -> float:
        return self.rate * x * (1.0 - x)
