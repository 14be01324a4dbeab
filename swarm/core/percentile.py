"""The nearest-rank percentile, which is one of the values itself."""

from collections.abc import Collection
from math import ceil, nan


def percentile(values: Collection[float], percent: float) -> float:
    """Return the smallest value that `percent` of 100 of them do not exceed; nan where there are none."""
    ordered = sorted(values)
    return ordered[max(0, ceil(percent / 100 * len(ordered)) - 1)] if ordered else nan
