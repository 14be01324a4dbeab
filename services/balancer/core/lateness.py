"""The lateness of the loop's ticks: the 99th percentile and the maximum of the last second."""

import math


class Lateness:
    """The last `window` ticks."""

    def __init__(self, window: int = 100) -> None:
        self._values = [0.0] * window
        self._next = 0

    def add(self, lateness: float) -> None:
        """Take one tick's lateness, s."""
        self._values[self._next] = lateness
        self._next = (self._next + 1) % len(self._values)

    def p99_and_max(self) -> tuple[float, float]:
        """Nearest-rank 99th percentile and maximum, s."""
        ordered = sorted(self._values)
        return ordered[math.ceil(0.99 * len(ordered)) - 1], ordered[-1]
