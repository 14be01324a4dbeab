"""Small linear systems in plain Python: a robot has no numpy, and theirs have at most a dozen unknowns."""

from collections.abc import Sequence
from math import fsum, sqrt

from swarm.errors import LocalError

SINGULAR = 1e-12
"""A pivot smaller than this part of its diagonal element is rounding error: the system has no single solution."""

Vector = list[float]
Matrix = list[list[float]]


class SingularError(LocalError):
    """The data do not determine all unknowns."""


def cholesky(matrix: Sequence[Sequence[float]], singular: float = SINGULAR) -> Matrix:
    """Return the lower triangle L with L L' = `matrix`, which is symmetric positive definite.

    Raises `SingularError` where a pivot is at most the part `singular` of its diagonal element."""
    size = len(matrix)
    lower = [[0.0] * size for _ in range(size)]
    for i in range(size):
        for j in range(i + 1):
            rest = matrix[i][j] - fsum(lower[i][k] * lower[j][k] for k in range(j))
            if i == j:
                if not rest > singular * abs(matrix[i][i]):
                    raise SingularError("the data do not determine all unknowns")
                lower[i][i] = sqrt(rest)
            else:
                lower[i][j] = rest / lower[j][j]
    return lower


def solve(matrix: Sequence[Sequence[float]], right: Sequence[float], singular: float = SINGULAR) -> Vector:
    """Return the x of `matrix` x = `right`; of the matrix and of `singular`, `cholesky` tells."""
    lower = cholesky(matrix, singular)
    size = len(right)
    y: Vector = []
    for i in range(size):
        y.append((right[i] - fsum(lower[i][k] * y[k] for k in range(i))) / lower[i][i])
    x = [0.0] * size
    for i in reversed(range(size)):
        x[i] = (y[i] - fsum(lower[k][i] * x[k] for k in range(i + 1, size))) / lower[i][i]
    return x


def least_squares(rows: Sequence[Sequence[float]], right: Sequence[float]) -> Vector:
    """Return the x of least sum of (row . x - right)^2; raises `SingularError`.

    By the normal equations, columns scaled to unit length first: good for the few well-chosen columns used here.
    """
    if not rows or len(rows) < len(rows[0]):
        raise SingularError(f"{len(rows)} equations for {len(rows[0]) if rows else 'some'} unknowns")
    size = len(rows[0])
    scale = [sqrt(fsum(row[j] * row[j] for row in rows)) or 1.0 for j in range(size)]
    normal = [[fsum(row[i] * row[j] for row in rows) / (scale[i] * scale[j]) for j in range(size)] for i in range(size)]
    moment = [fsum(row[i] * value for row, value in zip(rows, right, strict=True)) / scale[i] for i in range(size)]
    return [value / scale[i] for i, value in enumerate(solve(normal, moment))]
