"""The limits of fits that may be written. A fit that the samples do not determine is refused, with what to measure
next.

A DWM1001 reports distances about 5 % too long, and places about as much too far out (thesis, equations 2.8 and 2.10).
The bounds here are several times as wide: beyond them a place was told wrongly, an anchor stands elsewhere, or the
samples are of another module.
"""

from collections.abc import Sequence
from math import atan2, degrees, hypot, sqrt

from services.dwm.core.calibration.models import RangeModel
from services.dwm.core.calibration.samples import SampleGroup, Spot
from services.dwm.core.estimation.filters import mean
from swarm.config.types import Affine
from swarm.errors import LocalError

FEWEST_RANGE_PLACES = 3
FEWEST_PLACES = 4
SCALES = (0.6, 1.6)
"""Bounds of the slope of a model of ranges, and of the scale of a model of places in any direction."""
LONGEST_BIAS = 1.0
"""Largest change of a measured range by a model, m."""
DISTANCES = 0.3
"""Least difference between the distances to the modules, m. With less, a range's noise of 4 cm would look like a
scale."""
WIDTH = 0.1
"""Least standard deviation of the places across the line that fits them best, m."""
RANGE_ERROR = 0.10
"""Largest error of ranges at places left out of the fit, m rms; the thesis' recording has 0.027."""
PLACE_ERROR = 0.25
"""Largest error of places at places left out of the fit, m rms; the thesis' recording has 0.051."""
TURN = 45.0
"""Largest angle by which a model of places may turn them, degrees."""


def check_distances(groups: Sequence[SampleGroup]) -> None:
    """Raise `LocalError` where a gain and an offset cannot be told from these samples."""
    places = len({group.place for group in groups})
    if places < FEWEST_RANGE_PLACES:
        raise LocalError(
            f"ranges to modules of known place at {places} of at least {FEWEST_RANGE_PLACES} places: measure at "
            f"{FEWEST_RANGE_PLACES - places} more"
        )
    near, far = min(group.true for group in groups), max(group.true for group in groups)
    if far - near < DISTANCES:
        raise LocalError(
            f"all distances are between {near:.2f} and {far:.2f} m: a scale cannot be told from an offset; measure at "
            f"places nearer to the module or farther away, over {DISTANCES:g} m at least"
        )


def check_spots(spots: Sequence[Spot]) -> None:
    """Raise `LocalError` where these places do not span a plane."""
    if len(spots) < FEWEST_PLACES:
        raise LocalError(
            f"positions at {len(spots)} of at least {FEWEST_PLACES} places: measure at {FEWEST_PLACES - len(spots)} "
            "more, not all on one line (swarm calibrate fit --only distance takes the ranges alone)"
        )
    width, angle = _spread([(spot.x, spot.y) for spot in spots])
    if width < WIDTH:
        raise LocalError(
            f"all places lie within {100 * width:.0f} cm of one line, {degrees(angle):.0f} degrees from x: across it "
            "nothing is known; measure at places beside that line, some 0.5 m away"
        )


def check_ranges(model: RangeModel, groups: Sequence[SampleGroup], error: float, residuals: Sequence[float]) -> None:
    """Raise `LocalError` where the fitted model is none of a module's, or `error` is too large.

    `error` (m): rms at places left out of the fit. `residuals`: error (m) of each group under the model.
    """
    measured = [group.mean for group in groups]
    # gain m + log ln m is steepest or flattest at an end of the measured ranges.
    for at in (max(min(measured), model.low), max(measured)):
        slope = model.gain + (model.log / at if model.log else 0.0)
        if not SCALES[0] <= slope <= SCALES[1]:
            raise LocalError(_absurd(f"the model's slope at {at:.2f} m is {slope:.2f}, not {_scales()}"))
        bias = model.distance(at) - at
        if abs(bias) > LONGEST_BIAS:
            raise LocalError(_absurd(f"the model changes a range of {at:.2f} m by {bias:+.2f} m"))
    if not error <= RANGE_ERROR:
        worst = max(range(len(groups)), key=lambda i: abs(residuals[i]))
        where = f"place {groups[worst].place + 1}, {groups[worst].true:.2f} m from its module"
        raise LocalError(_residual("ranges", error, RANGE_ERROR, where, residuals[worst]))


def check_places(model: Affine, spots: Sequence[Spot], error: float, residuals: Sequence[float]) -> None:
    """Raise what `check` raises, for a model of places."""
    (a, b), (c, d) = model.matrix
    if a * d - b * c <= 0:
        raise LocalError(_absurd("the model mirrors places: are x and y of the places or of [[anchors]] exchanged?"))
    # Singular values of a 2 x 2 matrix: (p + q) and |p - q|, p the part that turns, q the part that mirrors.
    p, q = hypot(a + d, c - b) / 2, hypot(a - d, c + b) / 2
    turn = degrees(atan2(c - b, a + d))
    if not (SCALES[0] <= p - q and p + q <= SCALES[1]):
        raise LocalError(_absurd(f"the model's scales are {p - q:.2f} and {p + q:.2f}, not {_scales()}"))
    if abs(turn) > TURN:
        raise LocalError(
            _absurd(f"the model turns places by {turn:.0f} degrees: are x and y of [[anchors]] exchanged?")
        )
    if not error <= PLACE_ERROR:
        worst = max(range(len(spots)), key=lambda i: residuals[i])
        where = f"place {spots[worst].place + 1} at ({spots[worst].x:.2f}, {spots[worst].y:.2f}) m"
        raise LocalError(_residual("places", error, PLACE_ERROR, where, residuals[worst]))


def check_offset(offset: float) -> None:
    """Raise `LocalError` where a robot's own range offset (m) cannot be one."""
    if not abs(offset) <= LONGEST_BIAS / 2:
        raise LocalError(
            f"ranges {offset:+.2f} m too long on the mean: no module errs by more than {LONGEST_BIAS / 2:g} m; did the "
            "robot stand at this --place, and is the target where --target says?"
        )


def _spread(places: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Standard deviation (m) of places across the line that fits them best, and the angle of that line (rad)."""
    middle = mean([x for x, _ in places]), mean([y for _, y in places])
    u, v = [x - middle[0] for x, _ in places], [y - middle[1] for _, y in places]
    xx, yy = mean([x * x for x in u]), mean([y * y for y in v])
    xy = mean([x * y for x, y in zip(u, v, strict=True)])
    least = (xx + yy) / 2 - hypot((xx - yy) / 2, xy)
    return sqrt(max(0.0, least)), atan2(2 * xy, xx - yy) / 2


def _scales() -> str:
    return f"{SCALES[0]:g} to {SCALES[1]:g}"


def _absurd(what: str) -> str:
    return f"{what}. Nothing is written: check the places that were told, --target and [[anchors]], then measure anew"


def _residual(what: str, error: float, most: float, where: str, residual: float) -> str:
    told = "there are too few places to leave one out" if error == float("inf") else f"{100 * error:.0f} cm rms"
    return (
        f"the error of {what} at places left out of the fit is more than {100 * most:.0f} cm ({told}). Nothing is "
        f"written: the worst is {where} ({100 * residual:+.0f} cm); measure it anew, and a few places around it"
    )
