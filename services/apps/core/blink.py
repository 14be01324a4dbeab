"""The times at which an LED blinks by the swarm's common time: it goes on at k/f, and off for the other part of the
period.

Whoever has the same time and the same frequency blinks alike, whatever the delays of the links. At time t a frequency
that differs by e shifts the blinks by t e / f; so frequencies that consensus has brought together up to rounding are
put on a grid (`on_grid`), and are then the same number. Its lines lie at n / 1234.5678 Hz: the mean of frequencies that
people choose is never just between two of them.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

GRID_PER_HZ = 1234.5678
DUTY = 0.5
"""Share of a period for which it is on."""


class LedEdge(NamedTuple):
    """A change of the LED."""

    t: float
    """Mesh time, s."""
    on: bool


def on_grid(frequency: float) -> float:
    """Return the nearest frequency of the grid, at most 0.4 mHz off; Hz."""
    return max(1, round(frequency * GRID_PER_HZ)) / GRID_PER_HZ


def edges(frequency: float, begin: float, end: float) -> Iterator[LedEdge]:
    """Changes in [begin, end) of mesh time, in order; `frequency` in Hz."""
    k = math.floor(begin * frequency)
    while (on := k / frequency) < end:
        if on >= begin:
            yield LedEdge(on, on=True)
        off = (k + DUTY) / frequency
        if begin <= off < end:
            yield LedEdge(off, on=False)
        k += 1
