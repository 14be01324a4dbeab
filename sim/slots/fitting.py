"""The fit of a slot radio's parameter to recorded runs. Pure: runs come as the durations of their iterations."""

import math
import statistics
from collections.abc import Mapping, Sequence

from swarm.frozen import frozen

MODEL = 0.05
"""Share by which a model's pace may be wrong, besides the difference between seeds."""

STEPS = 400
"""Values that are tried, evenly by their logarithms."""


@frozen
class Curve:
    """One recorded run beside the model's."""

    recorded: float
    """Seconds that a recorded iteration took."""
    model: Mapping[float, Sequence[float]]
    """Seconds that an iteration of the model took with several seeds, by value of the parameter. All curves have the
    same values."""


@frozen
class FittedValue:
    """The value of a parameter that fits best."""

    value: float
    low: float
    high: float
    """All values between these fit as well, as far as seeds differ from one another and the model may be wrong."""
    factor: float
    """Factor by which model and recordings differ at the best value, rms."""


def fitted(curves: Sequence[Curve]) -> FittedValue:
    """Compare logarithms, so that a run twice too slow counts as one twice too fast. Between the values of the model
    paces are interpolated. Expects at least one curve with two values."""
    values = sorted(curves[0].model)
    first, last = math.log(values[0]), math.log(values[-1])
    tried = [math.exp(first + (last - first) * step / STEPS) for step in range(STEPS + 1)]
    squares = [
        statistics.fmean((_pace(curve, value) - math.log(curve.recorded)) ** 2 for curve in curves) for value in tried
    ]
    best = min(squares)
    spread = statistics.fmean(
        statistics.pvariance(map(math.log, paces)) for curve in curves for paces in curve.model.values()
    )
    good = [value for value, square in zip(tried, squares, strict=True) if square <= best + spread + MODEL**2]
    return FittedValue(tried[squares.index(best)], good[0], good[-1], math.exp(math.sqrt(best)))


def _pace(curve: Curve, value: float) -> float:
    """Return the logarithm of the model's pace at a value."""
    known = sorted(curve.model)
    place = next((n for n in range(1, len(known)) if value <= known[n]), len(known) - 1)
    below, above = known[place - 1], known[place]
    share = math.log(value / below) / math.log(above / below)
    a, b = (statistics.fmean(map(math.log, curve.model[each])) for each in (below, above))
    return a + share * (b - a)
