"""The place of a tag of known height from its distances to anchors at known places, with single wrong ones discounted.

Least squares of the range errors under Huber's loss: Gauss-Newton steps with weights made anew from the residuals
(iteratively reweighted least squares; Huber, "Robust Statistics", 1981, 7.8), steps damped while they do not pay.
A wall in between makes a range longer, never shorter, by decimetres: such a one shall not carry its square's weight.
With four ranges one that is far too long still drags the place along; so each is left out in turn, and stays out where
the others then agree so much better that its being too long is the smaller wonder.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import fsum, hypot, sqrt
from statistics import median

from swarm.frozen import frozen

TUNING = 1.345
"""Huber's constant: residuals beyond so many standard deviations count linearly; 95 % efficient without outliers."""

TOO_LONG = 2.576
"""Standard deviations beyond which a range that is too long costs no more: it is taken for one without line of sight
(99 % of those with one are nearer)."""

_STEPS = 50
_CONVERGED = 1e-4
"""Length of a step below which the search has converged, m: ranges err by some hundred times as much."""
_FLAT = 0.02
"""The anchors count as lying in a line when their spread across it is a smaller part of that along it."""
_FAR = 1000.0
"""Distance beyond which a solution is rejected, m."""
_DAMPING = 1e-3

Point = tuple[float, float, float]


@frozen
class Fix:
    """A place and how well it is known."""

    x: float
    """m."""
    y: float
    covariance: tuple[float, float, float]
    """Variances and covariance (xx, xy, yy), m^2, from geometry, weights and the assumed range error."""
    residuals: tuple[float, ...]
    """Measured minus computed distance, m, in the order of the ranges."""
    weights: tuple[float, ...]
    """Weight of each range in the solution, 0 to 1."""


@frozen
class NoFix:
    """Why the ranges give no place."""

    reason: str


def multilaterate(anchors: Sequence[Point], distances: Sequence[float], height: float, sigma: float) -> Fix | NoFix:
    """Return the place of a tag at `height` (m). `sigma`: standard deviation of a good range, m.

    `anchors` are (x, y, z) in m. Anchors in a line leave the side of the line open, and fewer than three any
    side: both give `NoFix` with the reason, as does an iteration that leads nowhere.
    """
    fix = _solve(anchors, distances, height, sigma)
    if len(anchors) < 4 or isinstance(fix, NoFix):
        return fix
    cost = _wonder(fix.residuals, sigma)
    if cost <= (TOO_LONG * sigma) ** 2:
        return fix  # a range that is left out costs that much by itself, so no other place can cost less
    for i in range(len(anchors)):
        rest = [anchor for j, anchor in enumerate(anchors) if j != i]
        other = _solve(rest, [d for j, d in enumerate(distances) if j != i], height, sigma)
        if isinstance(other, Fix):
            residual = _terms(anchors[i], distances[i], height, other.x, other.y)[2]
            if residual > TOO_LONG * sigma and _wonder((*other.residuals, residual), sigma) < cost:
                cost = _wonder((*other.residuals, residual), sigma)
                fix = replace(
                    other,
                    residuals=(*other.residuals[:i], residual, *other.residuals[i:]),
                    weights=(*other.weights[:i], 0.0, *other.weights[i:]),
                )
    return fix


def _wonder(residuals: Sequence[float], sigma: float) -> float:
    """Return a cost of residuals: the sum of squares, where a residual above `TOO_LONG` sigma counts as that much."""
    limit = TOO_LONG * sigma
    return fsum(r * r if r <= limit else limit * limit for r in residuals)


def _solve(anchors: Sequence[Point], distances: Sequence[float], height: float, sigma: float) -> Fix | NoFix:
    """Return the place with the least of Huber's loss."""
    if len(anchors) < 3:
        return NoFix(f"{len(anchors)} ranges, three are needed")
    if (problem := degenerate(anchors)) is not None:
        return NoFix(problem)
    best: tuple[float, tuple[float, float]] | None = None
    for start in _starts(anchors, distances, height, sigma):
        place = _descend(anchors, distances, height, sigma, start)
        if place is not None:
            cost = _cost(anchors, distances, height, sigma, place)
            if best is None or cost < best[0]:
                best = cost, place
    if best is None:
        return NoFix("the ranges contradict each other: no place fits them")
    return _fix(anchors, distances, height, sigma, best[1])


def degenerate(anchors: Sequence[Point]) -> str | None:
    """Explain what is wrong with the anchors' geometry in the plane; None where nothing is."""
    x, y = (fsum(anchor[axis] for anchor in anchors) / len(anchors) for axis in (0, 1))
    xx = fsum((anchor[0] - x) ** 2 for anchor in anchors)
    yy = fsum((anchor[1] - y) ** 2 for anchor in anchors)
    xy = fsum((anchor[0] - x) * (anchor[1] - y) for anchor in anchors)
    half, spread = (xx + yy) / 2, sqrt(((xx - yy) / 2) ** 2 + xy * xy)
    if half + spread < 1e-6:
        return "all anchors are at one place"
    across = sqrt(max(0.0, half - spread) / (half + spread))
    if across < _FLAT:
        return "the anchors lie in a line: either side of it would fit; move one out of it"
    return None


def _starts(
    anchors: Sequence[Point], distances: Sequence[float], height: float, sigma: float
) -> list[tuple[float, float]]:
    """Return the two likeliest of the anchors' centre and the points where two circles of the plane meet: the error
    may have further local minima (near the mirror image of a place outside of the anchors' hull, where a range is
    wrong, where an anchor is high above), and for exact ranges one of the meeting points is the place itself."""
    x, y = (fsum(anchor[axis] for anchor in anchors) / len(anchors) for axis in (0, 1))
    circles = [
        (anchor[0], anchor[1], sqrt(max(0.0, distance * distance - (height - anchor[2]) ** 2)))
        for anchor, distance in zip(anchors, distances, strict=True)
    ]
    points = [point for i, one in enumerate(circles) for other in circles[:i] for point in _meetings(one, other)]
    return sorted([(x, y), *points], key=lambda point: _cost(anchors, distances, height, sigma, point))[:2]


def _meetings(one: tuple[float, float, float], other: tuple[float, float, float]) -> list[tuple[float, float]]:
    """Return the intersections of two circles (x, y, radius). Where they do not intersect, return the point between
    them on the line through their centres."""
    dx, dy = other[0] - one[0], other[1] - one[1]
    distance = hypot(dx, dy)
    if distance < 1e-6:
        return []
    along = (distance + (one[2] - other[2]) * (one[2] + other[2]) / distance) / 2
    across = sqrt(max(0.0, one[2] * one[2] - along * along))
    ux, uy = dx / distance, dy / distance
    return [(one[0] + along * ux - side * uy, one[1] + along * uy + side * ux) for side in (across, -across)]


def _terms(anchor: Point, measured: float, height: float, x: float, y: float) -> tuple[float, float, float]:
    """Direction of the range's growth (a unit vector's part in the plane) and its residual."""
    dx, dy, dz = x - anchor[0], y - anchor[1], height - anchor[2]
    distance = sqrt(dx * dx + dy * dy + dz * dz) or 1e-9
    return dx / distance, dy / distance, measured - distance


def _weight(residual: float, sigma: float) -> float:
    limit = TUNING * sigma
    return 1.0 if abs(residual) <= limit else limit / abs(residual)


def _cost(
    anchors: Sequence[Point], distances: Sequence[float], height: float, sigma: float, place: tuple[float, float]
) -> float:
    limit = TUNING * sigma
    total = 0.0
    for anchor, measured in zip(anchors, distances, strict=True):
        error = abs(_terms(anchor, measured, height, *place)[2])
        total += 0.5 * error * error if error <= limit else limit * (error - 0.5 * limit)
    return total


def _descend(
    anchors: Sequence[Point], distances: Sequence[float], height: float, sigma: float, start: tuple[float, float]
) -> tuple[float, float] | None:
    place, damping = start, _DAMPING
    cost = _cost(anchors, distances, height, sigma, place)
    for _ in range(_STEPS):
        xx = xy = yy = xe = ye = 0.0
        for anchor, measured in zip(anchors, distances, strict=True):
            ux, uy, error = _terms(anchor, measured, height, *place)
            weight = _weight(error, sigma)
            xx, xy, yy = xx + weight * ux * ux, xy + weight * ux * uy, yy + weight * uy * uy
            xe, ye = xe + weight * ux * error, ye + weight * uy * error
        lift = damping * (xx + yy)
        determinant = (xx + lift) * (yy + lift) - xy * xy
        if not determinant > 0.0:
            return None
        step = (((yy + lift) * xe - xy * ye) / determinant, ((xx + lift) * ye - xy * xe) / determinant)
        trial = place[0] + step[0], place[1] + step[1]
        trial_cost = _cost(anchors, distances, height, sigma, trial)
        if trial_cost <= cost:
            place, cost, damping = trial, trial_cost, damping / 5
            if hypot(*step) < _CONVERGED:
                break
        else:
            damping = max(damping, _DAMPING) * 10
            if damping > 1e9:  # as good as it gets in floating point
                break
    return place if hypot(*place) < _FAR else None


def _fix(
    anchors: Sequence[Point], distances: Sequence[float], height: float, sigma: float, place: tuple[float, float]
) -> Fix | NoFix:
    terms = [_terms(anchor, d, height, *place) for anchor, d in zip(anchors, distances, strict=True)]
    weights = tuple([_weight(error, sigma) for _, _, error in terms])
    xx, xy, yy = (
        fsum(w * term[i] * term[j] for w, term in zip(weights, terms, strict=True)) for i, j in ((0, 0), (0, 1), (1, 1))
    )
    determinant = xx * yy - xy * xy
    if determinant < 1e-4 * (xx + yy) ** 2:
        return NoFix("the anchors are seen in one direction: the place across it is not determined")
    # Ranges that fit worse than assumed say that sigma was too small.
    spread = max(sigma, 1.4826 * median(abs(term[2]) for term in terms) * sqrt(len(terms) / (len(terms) - 2)))
    variance = spread * spread / determinant
    covariance = (yy * variance, -xy * variance, xx * variance)
    return Fix(*place, covariance, tuple([term[2] for term in terms]), weights)
