"""The eigenvalues of a graph's Metropolis weights between which accelerated consensus works.

Of the symmetric doubly stochastic W one eigenvalue is 1, with the vector of ones: agreement. The others say how fast
disagreement dies away; second-order and Chebyshev iterations are tuned to the largest and the smallest of them.

Plain Python, since robots work them out by themselves: Lanczos iterations on the space orthogonal to the ones, each
vector orthogonalized against all before it (Golub, Van Loan, Matrix Computations, 10.1 and 10.3), then bisection on the
tridiagonal matrix by Sturm sequences (8.4). Exact but for rounding up to `MAX_STEPS` + 1 robots; beyond that the
values lie a little too far inside, and iterations tuned to them converge all the same, a little slower.
"""

import math
from functools import lru_cache
from itertools import islice

from swarm.core.graph import Graph, splitmix64

MAX_STEPS = 96
"""Lanczos vectors at most: a thousand robots take a second or two on a laptop, 64 robots a tenth of that on a Pi."""

_INVARIANT = 1e-12
"""A next vector shorter than this is none: the space found already holds all the eigenvectors that matter."""

_BISECTIONS = 60
"""Steps that halve an interval of length 2 down to the last bit of a float."""


@lru_cache(maxsize=64)
def bounds(graph: Graph, name: str) -> tuple[float, float]:
    """Smallest and largest eigenvalue of W besides that of agreement, in the connected part that `name` is in.

    (0, 0) for a robot alone: nothing disagrees.
    """
    part = next(part for part in graph.components() if name in part)
    return _bounds(graph, part)


@lru_cache(maxsize=64)
def _bounds(graph: Graph, part: tuple[str, ...]) -> tuple[float, float]:
    if len(part) == 1:
        return 0.0, 0.0
    place = {name: i for i, name in enumerate(part)}
    weights = [[(place[other], w) for other, w in graph.metropolis_weights(name).items()] for name in part]
    diagonal, beside = _lanczos(weights)
    return _eigenvalue(diagonal, beside, 1), _eigenvalue(diagonal, beside, len(diagonal))


def _lanczos(weights: list[list[tuple[int, float]]]) -> tuple[list[float], list[float]]:
    """Diagonal and off-diagonal of the tridiagonal matrix that W becomes on the Krylov space of a random vector."""
    count = len(weights)
    ones = [1.0 / math.sqrt(count)] * count
    vector = [number / 2**63 - 1.0 for number in islice(splitmix64(count), count)]
    basis = [ones]
    diagonal: list[float] = []
    beside: list[float] = []
    for _ in range(min(count - 1, MAX_STEPS)):
        # Twice: once leaves a remainder as large as the rounding of what was taken away.
        for _ in range(2):
            for known in basis:
                share = _dot(vector, known)
                vector = [v - share * q for v, q in zip(vector, known, strict=True)]
        length = math.sqrt(_dot(vector, vector))
        if length < _INVARIANT:
            break
        if diagonal:
            beside.append(length)
        vector = [v / length for v in vector]
        basis.append(vector)
        image = [
            own + math.fsum(w * (vector[j] - own) for j, w in row) for own, row in zip(vector, weights, strict=True)
        ]
        diagonal.append(_dot(vector, image))
        vector = image
    return diagonal, beside


def _eigenvalue(diagonal: list[float], beside: list[float], number: int) -> float:
    """Return the `number`-th smallest eigenvalue of a tridiagonal matrix whose eigenvalues lie in [-1, 1]."""
    squares = [0.0, *(b * b for b in beside)]
    low, high = -1.0, 1.0
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        below, pivot = 0, 1.0
        for a, square in zip(diagonal, squares, strict=True):
            pivot = a - middle - square / (pivot or 1e-300)
            below += pivot < 0.0
        low, high = (low, middle) if below >= number else (middle, high)
    return (low + high) / 2


def _dot(a: list[float], b: list[float]) -> float:
    return math.fsum(x * y for x, y in zip(a, b, strict=True))
