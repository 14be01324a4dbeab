"""Fits a robot's calibration to samples, and lets a model other than the thesis' in only when it wins.

Models compete on places they have not seen: each place is left out in turn, the rest is fitted, and the error at the
mean of the place that was left out counts ("leave one place out"). More samples at a place are no more evidence than
few: its own multipath and antenna errors do not average out. A model wins over the linear one when the squares of its
errors are smaller by more than their standard error over the places, and when it is not worse where all places of one
distance are left out, so that it must reach beyond what it has seen. Else the linear model stays. What the choice
itself is worth is judged by the same choice made anew without each place.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import cos, fsum, hypot, inf, sin, sqrt
from math import log as ln
from statistics import stdev

from services.dwm.core.calibration import limits
from services.dwm.core.calibration.models import RangeModel, position
from services.dwm.core.calibration.samples import SampleGroup, Spot
from services.dwm.core.estimation.filters import Place, mean
from swarm.config.types import Affine
from swarm.core.linear import SingularError, least_squares
from swarm.frozen import frozen

MARGIN = 0.98
"""A model of places with fewer unknowns than the thesis' wins when its error is at most this part of that one's."""

CURVED = 0.6
"""Share of the logarithmic model in the curved one. On the thesis' recording the logarithmic model alone errs less
still (2.65 cm at places left out, curved 2.72, linear 2.90), but with halves of the places left out at random it is
worse than the linear one twice as often (9 % of the halves against 5 %)."""

_SAME = 0.05
"""Distances that differ by less than this count as one, m."""
_FEWEST_DISTANCES = 5
"""Number of different distances below which only the linear model is tried."""
_FEWEST_ORIENTATIONS = 3

RangeFit = Callable[[Sequence[SampleGroup]], RangeModel]
Folds = Callable[[Sequence[SampleGroup]], list[set[int]]]
PlaceFit = Callable[[Sequence[Spot]], Affine]


@frozen
class FittedRanges:
    """A model of ranges and what is known of its worth; errors are rms in m."""

    name: str
    model: RangeModel
    left_out: dict[str, float]
    """Error at places left out, by model; `raw` stands for no model."""
    nested: float
    """Error at places left out of the whole procedure, with the choice of the model."""
    residuals: tuple[tuple[float, float], ...]
    """(true distance, error of the calibrated mean) of each group."""


@frozen
class PlaceFitted:
    """A model of places and what is known of its worth; errors are rms of the distance in m."""

    name: str
    model: Affine
    left_out: dict[str, float]
    nested: float
    residuals: tuple[tuple[float, float, float], ...]
    """(true x, true y, error) of each place."""


# ---- ranges


def fit_linear(groups: Sequence[SampleGroup]) -> RangeModel:
    """distance = gain m + offset."""
    gain, offset = least_squares([[g.mean, 1.0] for g in groups], [g.true for g in groups])
    return RangeModel(gain, offset)


def fit_logarithmic(groups: Sequence[SampleGroup]) -> RangeModel:
    """distance = m + offset + log ln m: two unknowns, as the linear model has."""
    log, offset = least_squares([[ln(max(g.mean, 0.01)), 1.0] for g in groups], [g.true - g.mean for g in groups])
    return RangeModel(1.0, offset, log, max(0.01, min(g.mean for g in groups)))


def fit_curved(groups: Sequence[SampleGroup]) -> RangeModel:
    """Between the two, nearer to the logarithmic one: where either errs, the other holds back."""
    line, curve = fit_linear(groups), fit_logarithmic(groups)
    return RangeModel(
        line.gain + CURVED * (curve.gain - line.gain),
        line.offset + CURVED * (curve.offset - line.offset),
        CURVED * curve.log,
        curve.low,
    )


def with_antenna(fit: RangeFit) -> RangeFit:
    """Return a fit that adds a cos(heading) + b sin(heading), fitted to the errors that `fit` leaves at each place."""

    def fitted(groups: Sequence[SampleGroup]) -> RangeModel:
        model = fit(groups)
        rows, right = [], []
        for place in sorted({g.place for g in groups}):
            of = [g for g in groups if g.place == place and g.heading is not None]
            if len(of) < 2:
                continue
            # Against the place's own mean: the place's bias is none of the antenna's.
            waves = [(cos(g.heading or 0.0), sin(g.heading or 0.0)) for g in of]
            errors = [model.distance(g.mean) - g.true for g in of]
            middle = [fsum(column) / len(of) for column in (*zip(*waves, strict=True), errors)]
            rows += [[c - middle[0], s - middle[1]] for c, s in waves]
            right += [error - middle[2] for error in errors]
        a, b = least_squares(rows, right)
        return replace(model, antenna=(a, b))

    return fitted


def error_of(model: RangeModel, group: SampleGroup, measured: float) -> float:
    """Calibrated minus true distance, m."""
    a, b = model.antenna
    wave = 0.0 if group.heading is None else a * cos(group.heading) + b * sin(group.heading)
    return model.distance(measured) - wave - group.true


def fit_ranges(groups: Sequence[SampleGroup]) -> FittedRanges:
    """Fit, compare and choose. Raises `LocalError` where the samples determine no model that may be written."""
    limits.check_distances(groups)
    name, fit = _choose_range(groups)
    model = fit(groups)
    left_out = {"raw": rms([g.raw_mean - g.true for g in groups])}
    left_out |= {other: _left_out(groups, other_fit) for other, other_fit in _range_models(groups).items()}
    nested = _left_out(groups, lambda seen: _choose_range(seen)[1](seen))
    residuals = tuple((g.true, error_of(model, g, g.mean)) for g in groups)
    limits.check_ranges(model, groups, nested, [error for _, error in residuals])
    return FittedRanges(name, model, left_out, nested, residuals)


def robot_offset(model: RangeModel, groups: Sequence[SampleGroup]) -> float:
    """Return the amount by which a robot's ranges are too long under `model`, m: the mean over places, each counting
    once.

    From one place alone it cannot be told from that place's own error (multipath, an anchor measured wrongly).
    """
    places: dict[int, list[float]] = {}
    for group in groups:
        places.setdefault(group.place, []).append(error_of(model, group, group.mean))
    return mean([mean(errors) for errors in places.values()])


def _range_models(groups: Sequence[SampleGroup]) -> dict[str, RangeFit]:
    """Return the models that these samples allow."""
    models: dict[str, RangeFit] = {"linear": fit_linear}
    if len(_by_distance(groups)) >= _FEWEST_DISTANCES:
        models["curved"] = fit_curved
    if len({g.heading for g in groups} - {None}) >= _FEWEST_ORIENTATIONS:
        models |= {f"{name} + heading": with_antenna(fit) for name, fit in models.items()}
    return models


def _choose_range(groups: Sequence[SampleGroup]) -> tuple[str, RangeFit]:
    models = _range_models(groups)
    name = "linear"
    if "curved" in models:
        other = models["curved"]
        linear = models["linear"]
        beyond = _left_out(groups, other, _by_distance) <= _left_out(groups, linear, _by_distance)
        if beyond and _wins(groups, other, linear):
            name = "curved"
    turned = f"{name} + heading"
    if turned in models and _wins(groups, models[turned], models[name]):
        name = turned
    return name, models[name]


def _by_place(groups: Sequence[SampleGroup]) -> list[set[int]]:
    return [{place} for place in sorted({g.place for g in groups})]


def _by_distance(groups: Sequence[SampleGroup]) -> list[set[int]]:
    """Places that are equally far from the module they range to; with several modules, from the nearest."""
    nearest: dict[int, float] = {}
    for g in groups:
        nearest[g.place] = min(g.true, nearest.get(g.place, g.true))
    shells: list[set[int]] = []
    last = -1.0
    for place, true in sorted(nearest.items(), key=lambda item: item[1]):
        if not shells or true - last > _SAME:
            shells.append(set())
        shells[-1].add(place)
        last = true
    return shells


def _wins(groups: Sequence[SampleGroup], fit: RangeFit, rival: RangeFit) -> bool:
    """Return whether the gain in squared error, place by place left out, exceeds its standard error."""
    ours, theirs = (_errors_left_out(groups, one, _by_place) for one in (fit, rival))
    if ours is None or theirs is None:
        return theirs is None and ours is not None
    gains = [
        mean([error * error for error in b]) - mean([error * error for error in a])
        for a, b in zip(ours, theirs, strict=True)
    ]
    return mean(gains) > stdev(gains) / sqrt(len(gains))


def _left_out(groups: Sequence[SampleGroup], fit: RangeFit, folds: Folds | None = None) -> float:
    """rms error at places left out of the fit; infinite where what is left determines no model."""
    errors = _errors_left_out(groups, fit, folds or _by_place)
    return inf if errors is None else rms([error for of in errors for error in of])


def _errors_left_out(groups: Sequence[SampleGroup], fit: RangeFit, folds: Folds) -> list[list[float]] | None:
    """Errors by what was left out."""
    errors = []
    for places in folds(groups):
        try:
            model = fit([g for g in groups if g.place not in places])
        except SingularError:
            return None
        errors.append([error_of(model, g, g.raw_mean) for g in groups if g.place in places])
    return errors


# ---- places


def fit_affine(spots: Sequence[Spot]) -> Affine:
    """Return the thesis' model (eq. 2.10): a matrix of four and an offset of two."""
    rows = [[*spot.mean, 1.0] for spot in spots]
    a, b, e = least_squares(rows, [spot.x for spot in spots])
    c, d, f = least_squares(rows, [spot.y for spot in spots])
    return Affine(((a, b), (c, d)), (e, f))


def fit_stretched(spots: Sequence[Spot]) -> Affine:
    """Fit a scale for each axis and an offset."""
    a, e = least_squares([[spot.mean[0], 1.0] for spot in spots], [spot.x for spot in spots])
    d, f = least_squares([[spot.mean[1], 1.0] for spot in spots], [spot.y for spot in spots])
    return Affine(((a, 0.0), (0.0, d)), (e, f))


def fit_scaled(spots: Sequence[Spot]) -> Affine:
    """Fit one scale and an offset, which correct the effect of too long ranges on a place."""
    rows = [[spot.mean[0], 1.0, 0.0] for spot in spots] + [[spot.mean[1], 0.0, 1.0] for spot in spots]
    scale, e, f = least_squares(rows, [spot.x for spot in spots] + [spot.y for spot in spots])
    return Affine(((scale, 0.0), (0.0, scale)), (e, f))


PLACE_MODELS: dict[str, PlaceFit] = {"affine": fit_affine, "stretched": fit_stretched, "scaled": fit_scaled}


def fit_places(spots: Sequence[Spot]) -> PlaceFitted:
    """Fit, compare and choose. Raises `LocalError` where the samples determine no model that may be written."""
    limits.check_spots(spots)
    name = _choose_place(spots)
    model = PLACE_MODELS[name](spots)
    left_out = {"raw": rms([hypot(s.raw_mean[0] - s.x, s.raw_mean[1] - s.y) for s in spots])}
    left_out |= {other: _places_left_out(spots, fit) for other, fit in PLACE_MODELS.items()}
    nested = _places_left_out(spots, lambda seen: PLACE_MODELS[_choose_place(seen)](seen))
    residuals = tuple((s.x, s.y, place_error(model, s, s.mean)) for s in spots)
    limits.check_places(model, spots, nested, [error for _, _, error in residuals])
    return PlaceFitted(name, model, left_out, nested, residuals)


def place_error(model: Affine, spot: Spot, measured: Place) -> float:
    """Distance of the calibrated from the true place, m."""
    x, y = position(model, *measured)
    return hypot(x - spot.x, y - spot.y)


def _choose_place(spots: Sequence[Spot]) -> str:
    """Return the thesis' model, unless one of fewer unknowns wins: then the best of these."""
    errors = {name: _places_left_out(spots, fit) for name, fit in PLACE_MODELS.items()}
    best = min(errors, key=lambda name: errors[name])
    return best if errors[best] <= MARGIN * errors["affine"] else "affine"


def _places_left_out(spots: Sequence[Spot], fit: PlaceFit) -> float:
    errors = []
    for spot in spots:
        try:
            model = fit([other for other in spots if other is not spot])
        except SingularError:
            return inf
        errors.append(place_error(model, spot, spot.raw_mean))
    return rms(errors)


def rms(values: Sequence[float]) -> float:
    """Return the root of the mean square."""
    return sqrt(mean([value * value for value in values]))
