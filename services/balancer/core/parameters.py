"""Numbers that may change while the robot runs: by name, each within its range, all of a change or none."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from swarm.errors import LocalError


class BalancerParameter(NamedTuple):
    """One of them."""

    value: float
    """The value at the start."""
    low: float
    high: float


class BalancerParameters:
    """The values in force."""

    def __init__(self, table: Mapping[str, BalancerParameter]) -> None:
        self._table = dict(table)
        self.values = {name: parameter.value for name, parameter in table.items()}

    def change(self, values: Mapping[str, float]) -> None:
        """Take over `values`; raises `LocalError` that names the first wrong one, and then changes nothing."""
        for name, value in values.items():
            if name not in self._table:
                raise LocalError(f"parameter {name!r}: unknown, there are {', '.join(sorted(self._table))}")
            _, low, high = self._table[name]
            if not (math.isfinite(value) and low <= value <= high):
                raise LocalError(f"parameter {name}: expected {low:.4g} to {high:.4g}, got {value:.6g}")
        self.values.update(values)


def around(value: float, factor: float = 3.0) -> BalancerParameter:
    """Return a gain that may be changed by up to `factor` in both directions, its sign kept."""
    low, high = sorted((value / factor, value * factor))
    return BalancerParameter(value, low, high)
