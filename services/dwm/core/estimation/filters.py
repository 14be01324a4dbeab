"""Smoothing of what is measured again and again: outliers out, then a moving average (thesis 2.3.4).

An outlier of distances lies outside [Q1 - 1.5 IQR, Q3 + 1.5 IQR] (eq. 2.1). Of positions, the distance to the
centroid counts, with the upper bound alone (figure 2.12). What remains of the last N values is averaged (eq. 2.2).

The thesis' published figures come from a program that differs from its text: see `recursive_average`, and the
percentiles 40 and 60 in place of the quartiles for positions.
"""

from collections import deque
from collections.abc import Sequence
from math import floor, fsum, hypot

QUARTILES = (25.0, 75.0)
ORIGINAL_PERCENTILES = (40.0, 60.0)
"""The percentiles that the original program uses as Q1 and Q3 of positions."""

_REACH = 1.5
_FEWEST = 4
"""Least number of values in which an outlier can be recognised."""

Place = tuple[float, float]


def interpolated_percentile(values: Sequence[float], percent: float) -> float:
    """Linear between the order statistics, as numpy has it by default."""
    ordered = sorted(values)
    place = (len(ordered) - 1) * percent / 100
    low = floor(place)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (place - low) * (ordered[high] - ordered[low])


def bounds(values: Sequence[float], percents: tuple[float, float] = QUARTILES) -> tuple[float, float]:
    """Lower and upper bound of what is no outlier (eq. 2.1)."""
    first, third = interpolated_percentile(values, percents[0]), interpolated_percentile(values, percents[1])
    reach = _REACH * (third - first)
    return first - reach, third + reach


def inliers(values: Sequence[float], percents: tuple[float, float] = QUARTILES) -> list[float]:
    """Return the values within the bounds, in order; all of them where there are fewer than four."""
    if len(values) < _FEWEST:
        return list(values)
    low, high = bounds(values, percents)
    return [value for value in values if low <= value <= high]


def inlying_places(places: Sequence[Place], percents: tuple[float, float] = QUARTILES) -> list[Place]:
    """Return the places not farther from the centroid than the upper bound of these distances (figure 2.12), in
    order."""
    if len(places) < _FEWEST:
        return list(places)
    x, y = mean([place[0] for place in places]), mean([place[1] for place in places])
    radii = [hypot(place[0] - x, place[1] - y) for place in places]
    limit = bounds(radii, percents)[1]
    return [place for place, radius in zip(places, radii, strict=True) if radius <= limit]


def mean(values: Sequence[float]) -> float:
    return fsum(values) / len(values)


def recursive_average(values: Sequence[float], window: int) -> list[float]:
    """Return the averages of the original program, which averages in place, so earlier **means** enter (not eq. 2.2).

    Kept to reproduce the thesis' figures; it weights the first values of a place most.
    """
    out: list[float] = []
    for value in values:
        last = [*out[max(0, len(out) + 1 - window) :], value]
        out.append(mean(last))
    return out


class RangeFilter:
    """Distances as they come: the mean of the inliers among the last `window` values."""

    def __init__(self, window: int) -> None:
        self._values: deque[float] = deque(maxlen=window)

    def add(self, value: float) -> float:
        """Take a value and give the mean."""
        self._values.append(value)
        return mean(inliers(self._values))

    def clear(self) -> None:
        self._values.clear()


class PlaceFilter:
    """Positions as they come: the mean of the inliers among the last `window` ones."""

    def __init__(self, window: int) -> None:
        self._places: deque[Place] = deque(maxlen=window)

    def add(self, x: float, y: float) -> Place:
        """Take a place and give the mean."""
        self._places.append((x, y))
        kept = inlying_places(self._places)
        return mean([place[0] for place in kept]), mean([place[1] for place in kept])

    def clear(self) -> None:
        self._places.clear()
