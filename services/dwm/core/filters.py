"""Smoothing of what is measured again and again."""

from collections import deque
from math import fsum


class MovingAverage:
    """The mean of the last `window` values (eq. 2.2), of as many as there are while they are fewer."""

    def __init__(self, window: int) -> None:
        self._values: deque[float] = deque(maxlen=window)

    def add(self, value: float) -> float:
        """Take a value and give the mean."""
        self._values.append(value)
        return fsum(self._values) / len(self._values)

    def clear(self) -> None:
        """Forget all values."""
        self._values.clear()
