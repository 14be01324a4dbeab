"""The figures of the thesis' section 2.3.4 from its own recording, by what its program did.

Distances (eqs 2.4 and 2.8, table 2.3): samples pooled by true distance, outliers out by the quartiles, a window of 5
averaged in place, a line through the ten means. The table's errors are then taken at the means of **all** samples.
Places (eq. 2.10, table 2.4): outliers by the percentiles 40 and 60, the same average; the equation from all 22 places,
the table and figure 2.14 from 20 (without (200,100) and (50,0)), and the table's rms is that of single coordinates.
"""

from collections.abc import Sequence
from math import hypot, sqrt

from services.dwm.core.calibration.models import position
from services.dwm.core.calibration.samples import THESIS_PLACES_CM, RangeSample
from services.dwm.core.estimation.filters import (
    ORIGINAL_PERCENTILES,
    Place,
    inliers,
    inlying_places,
    interpolated_percentile,
    mean,
    recursive_average,
)
from swarm.config.types import Affine
from swarm.core.linear import least_squares
from swarm.frozen import frozen

WINDOW = 5

TRUE_CM = (
    25.0, 25.0, 50.0, 75.0, 100.0, 125.0, 150.0, 100.0, 75.0, 50.0, 25.0, 25.0, 50.0, 75.0, 70.0, 113.0, 113.0, 70.0,
    90.14, 145.77, 145.77, 90.14,
)  # fmt: skip
"""Distances of the places to the target that the program used; four are rounded from 70.71 and 111.80."""

_NOT_IN_TABLE = (THESIS_PLACES_CM.index((200, 100)), THESIS_PLACES_CM.index((50, 0)))


@frozen
class DistanceFigures:
    """Lengths in cm."""

    samples: int
    outliers: int
    gain: float
    """The gain of eq. 2.4, m = gain d + offset; eq. 2.8 is its inverse."""
    offset: float
    uncalibrated: tuple[float, float]
    """Mean and rms about it, table 2.3."""
    calibrated: tuple[float, float]
    raw_90: float
    """Figure 2.11: 90 % of the raw samples are not farther from the truth."""
    processed_90: float
    processed_80: float


@frozen
class PositionFigures:
    """Lengths in cm."""

    model: Affine
    """Eq. 2.10."""
    uncalibrated: tuple[float, float]
    """Mean and rms of all coordinates, table 2.4."""
    calibrated: tuple[float, float]
    uncalibrated_2d: float
    """rms of the distance, which the table does not say."""
    calibrated_2d: float
    raw_90: float
    """Figure 2.14."""
    processed_90: float


def distances(samples: Sequence[RangeSample]) -> DistanceFigures:
    """Eqs 2.4 and 2.8, table 2.3 and figure 2.11 from the samples of the thesis' calibration."""
    pools: dict[float, list[float]] = {}
    for sample in samples:
        pools.setdefault(TRUE_CM[sample.place], []).append(sample.distance * 100)
    true = sorted(pools)
    kept = {d: inliers(pools[d]) for d in true}
    smooth = {d: recursive_average(kept[d], WINDOW) for d in true}
    gain, offset = least_squares([[d, 1.0] for d in true], [mean(smooth[d]) for d in true])
    means = [mean(pools[d]) for d in true]
    processed = [abs((value - offset) / gain - d) for d in true for value in smooth[d]]
    return DistanceFigures(
        len(samples),
        sum(len(pools[d]) - len(kept[d]) for d in true),
        gain,
        offset,
        _mean_and_rms([d - m for d, m in zip(true, means, strict=True)]),
        _mean_and_rms([gain * d + offset - m for d, m in zip(true, means, strict=True)]),
        interpolated_percentile([abs(value - d) for d in true for value in pools[d]], 90),
        interpolated_percentile(processed, 90),
        interpolated_percentile(processed, 80),
    )


def positions(samples: Sequence[RangeSample]) -> PositionFigures:
    """Eq. 2.10, table 2.4 and figure 2.14 from the samples of the thesis' calibration."""
    raw: dict[int, list[Place]] = {}
    for sample in samples:
        if sample.px is not None and sample.py is not None:
            raw.setdefault(sample.place, []).append((sample.px * 100, sample.py * 100))
    smooth = {place: _smooth(values) for place, values in raw.items()}
    means = {
        place: (mean([value[0] for value in values]), mean([value[1] for value in values]))
        for place, values in smooth.items()
    }
    model = _affine(means)
    table = {place: value for place, value in means.items() if place not in _NOT_IN_TABLE}
    of_table = _affine(table)
    before = [_error(place, value) for place, value in table.items()]
    after = [_error(place, position(of_table, *value)) for place, value in table.items()]
    return PositionFigures(
        model,
        _mean_and_rms([c for error in before for c in error]),
        _mean_and_rms([c for error in after for c in error]),
        sqrt(mean([hypot(*error) ** 2 for error in before])),
        sqrt(mean([hypot(*error) ** 2 for error in after])),
        interpolated_percentile([hypot(*_error(place, value)) for place in table for value in raw[place]], 90),
        interpolated_percentile(
            [hypot(*_error(p, position(of_table, *value))) for p in table for value in smooth[p]], 90
        ),
    )


def _smooth(values: Sequence[Place]) -> list[Place]:
    kept = inlying_places(values, ORIGINAL_PERCENTILES)
    x, y = (recursive_average([value[axis] for value in kept], WINDOW) for axis in (0, 1))
    return list(zip(x, y, strict=True))


def _affine(means: dict[int, Place]) -> Affine:
    rows = [[*value, 1.0] for value in means.values()]
    a, b, e = least_squares(rows, [float(THESIS_PLACES_CM[place][0]) for place in means])
    c, d, f = least_squares(rows, [float(THESIS_PLACES_CM[place][1]) for place in means])
    return Affine(((a, b), (c, d)), (e, f))


def _error(place: int, value: Place) -> Place:
    return value[0] - THESIS_PLACES_CM[place][0], value[1] - THESIS_PLACES_CM[place][1]


def _mean_and_rms(values: Sequence[float]) -> tuple[float, float]:
    middle = mean(values)
    return middle, sqrt(mean([(value - middle) ** 2 for value in values]))
