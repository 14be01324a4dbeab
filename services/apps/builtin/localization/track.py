"""A target that moves in a straight line: least squares of squared ranges over the last iterations, with a velocity.

Of a target at x with velocity v (m an iteration), the seven numbers

    Y = (x_1, x_2, |x|^2, v_1, v_2, x'v, |v|^2)

move linearly: one iteration on x is x + v, |x|^2 is |x|^2 + 2 x'v + |v|^2, x'v is x'v + |v|^2. A range now says
a'Y = b with a = (-2p, 1, 0, 0, 0, 0), as in `ranges`, and one of n iterations ago says it of Y then, which is linear in
Y now. So the information sum a a' / s^2 (28 numbers) and sum a b / s^2 (7) of all robots adds up, and prediction,

    M <- f F^-T M F^-1,    m <- f F^-T m,

is linear, too, the forgetting f taking the place of a process noise (Sorenson, Sacks, "Recursive fading memory
filtering", Information Sciences 3, 1971). So prediction and dynamic average consensus go together: the sum over the
swarm stays. Plain Python.
"""

import contextlib
import math
from dataclasses import replace
from math import fsum
from operator import mul

from services.apps.builtin.localization import ranges
from swarm.core.linear import SingularError
from swarm.core.linear import solve as solved
from swarm.frozen import frozen

SIZE = 7
TRIANGLE = tuple((i, j) for i in range(SIZE) for j in range(i, SIZE))
LENGTH = len(TRIANGLE) + SIZE
"""Numbers of the information: the upper triangle of M row by row, then m."""

Information = tuple[float, ...]
Matrix = list[list[float]]
Unknowns = tuple[float, float, float, float]
"""x, y, vx, vy."""

NOTHING: Information = (0.0,) * LENGTH

_STEPS = 4  # from the last velocity, one or two are enough
_SMALLEST_STEP = 1e-7  # m
_SINGULAR = 1e-14  # prior and ranges differ by many powers of ten


@frozen
class TargetMotion:
    """The target's place and velocity."""

    x: float
    """m."""
    y: float
    vx: float
    """m an iteration."""
    vy: float
    found: ranges.TargetEstimate
    """The place that follows from the ranges with that velocity, with its uncertainty and ambiguity."""


def information(distance: float, x: float, y: float, sigma: float) -> Information:
    """Return the information of one range, m, at the place (x, y). `sigma`: standard deviation of range and own
    place together, m."""
    m11, m12, m13, m22, m23, m33, v1, v2, v3 = ranges.statistics(distance, x, y, sigma)
    rest = (0.0,) * 4
    return (m11, m12, m13, *rest, m22, m23, *rest, m33, *rest, *(0.0,) * 10, v1, v2, v3, *rest)


def predict(information: Information, keep: float) -> Information:
    """Predict the information of the next iteration. `keep`: the share that is not forgotten."""
    matrix = [[0.0] * SIZE for _ in range(SIZE)]
    for (i, j), value in zip(TRIANGLE, information, strict=False):
        matrix[i][j] = matrix[j][i] = value
    rows = [_moved(row) for row in matrix]
    columns = [_moved(list(column)) for column in zip(*rows, strict=True)]
    vector = _moved(list(information[len(TRIANGLE) :]))
    return (*(keep * columns[j][i] for i, j in TRIANGLE), *(keep * value for value in vector))


def solve(information: Information, robots: int, slow: float, guess: tuple[float, float]) -> TargetMotion | None:
    """Return the place and velocity that fit best. `information` is the mean over `robots` robots.

    `slow`: standard deviation of a velocity component before anything is known, m an iteration; `guess`: a velocity to
    begin with. None where no range came in yet.
    """
    matrix = [[0.0] * SIZE for _ in range(SIZE)]
    for (i, j), value in zip(TRIANGLE, information, strict=False):
        matrix[i][j] = matrix[j][i] = value
    vector = information[len(TRIANGLE) :]
    prior = 1.0 / (robots * slow * slow)
    begin = ranges.solve(_given(matrix, vector, guess), robots)
    if begin is None:
        return None
    x, y, vx, vy = _descend(matrix, vector, (begin.x, begin.y, *guess), prior)
    found = ranges.solve(_given(matrix, vector, (vx, vy)), robots) or begin
    # Of place and velocity together: one that is not yet known makes the place less certain, too.
    hessian = _hessian(matrix, _slopes(x, y, vx, vy), prior)
    with contextlib.suppress(SingularError):
        first = solved(hessian, [1.0, 0.0, 0.0, 0.0], _SINGULAR)
        second = solved(hessian, [0.0, 1.0, 0.0, 0.0], _SINGULAR)
        found = replace(found, covariance=(first[0] / robots, first[1] / robots, second[1] / robots))
    return TargetMotion(x, y, vx, vy, found)


def _moved(a: list[float]) -> list[float]:
    """F^-T a: coefficients of Y now that say what `a` said of Y one iteration ago."""
    return [a[0], a[1], a[2], a[3] - a[0], a[4] - a[1], a[5] - 2.0 * a[2], a[6] + a[2] - a[5]]


def _given(matrix: Matrix, vector: Information, velocity: tuple[float, float]) -> ranges.Statistics:
    """Return the statistics of `ranges` of a target whose velocity is known: Y = B (x, y, |x|^2) + d."""
    vx, vy = velocity
    offset = (0.0, 0.0, 0.0, vx, vy, 0.0, vx * vx + vy * vy)
    rest = [v - fsum(m * d for m, d in zip(row, offset, strict=True)) for v, row in zip(vector, matrix, strict=True)]

    def fold(row: list[float]) -> tuple[float, float, float]:
        return row[0] + vx * row[5], row[1] + vy * row[5], row[2]

    folded = [fold(row) for row in matrix]
    m = [fold(list(column)) for column in zip(*folded, strict=True)]
    v = fold(rest)
    return (m[0][0], m[0][1], m[0][2], m[1][1], m[1][2], m[2][2], *v)


def _descend(matrix: Matrix, vector: Information, start: Unknowns, prior: float) -> Unknowns:
    """Gauss-Newton on the four unknowns: the least cost near `start`."""
    at, cost = start, _cost(matrix, vector, start, prior)
    for _ in range(_STEPS):
        full, slopes = _full(*at), _slopes(*at)
        residual = [v - fsum(map(mul, row, full)) for v, row in zip(vector, matrix, strict=True)]
        gradient = [fsum(map(mul, slope, residual)) for slope in slopes]
        for i in (2, 3):
            gradient[i] -= prior * at[i]
        try:
            step = solved(_hessian(matrix, slopes, prior), gradient, _SINGULAR)
        except SingularError:
            return at
        while math.hypot(*step) > _SMALLEST_STEP:
            there = (at[0] + step[0], at[1] + step[1], at[2] + step[2], at[3] + step[3])
            smaller = _cost(matrix, vector, there, prior)
            if smaller < cost:
                at, cost = there, smaller
                break
            step = [s / 2 for s in step]
        else:
            return at
    return at


def _full(x: float, y: float, vx: float, vy: float) -> tuple[float, ...]:
    """Return the vector Y."""
    return (x, y, x * x + y * y, vx, vy, x * vx + y * vy, vx * vx + vy * vy)


def _slopes(x: float, y: float, vx: float, vy: float) -> tuple[tuple[float, ...], ...]:
    """Y's derivatives with respect to x, y, vx, vy."""
    return (
        (1.0, 0.0, 2 * x, 0.0, 0.0, vx, 0.0),
        (0.0, 1.0, 2 * y, 0.0, 0.0, vy, 0.0),
        (0.0, 0.0, 0.0, 1.0, 0.0, x, 2 * vx),
        (0.0, 0.0, 0.0, 0.0, 1.0, y, 2 * vy),
    )


def _hessian(matrix: Matrix, slopes: tuple[tuple[float, ...], ...], prior: float) -> Matrix:
    images = [[fsum(map(mul, row, slope)) for row in matrix] for slope in slopes]
    hessian = [[fsum(map(mul, slope, image)) for image in images] for slope in slopes]
    for i in (2, 3):
        hessian[i][i] += prior
    return hessian


def _cost(matrix: Matrix, vector: Information, at: Unknowns, prior: float) -> float:
    full = _full(*at)
    square = fsum(f * fsum(map(mul, row, full)) for f, row in zip(full, matrix, strict=True))
    linear = fsum(map(mul, vector, full))
    return square - 2 * linear + prior * (at[2] * at[2] + at[3] * at[3])
