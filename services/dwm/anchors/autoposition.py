"""The places of anchors from the distances between them: multidimensional scaling, then alignment. For the laptop.

Classical scaling (Torgerson 1952) turns all distances into places at once; pairs that were not measured are filled in
by the shortest way over others for that. Least squares on the measured pairs then give each its due, from there and
from starts around it: there may be a local minimum where an anchor is on the wrong side of others. Distances say
nothing of where the whole is, how it is turned, and whether it is its mirror image: alignment decides that.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from swarm.errors import LocalError
from swarm.frozen import frozen

Pair = tuple[str, str]
Places = dict[str, tuple[float, float]]
Array = NDArray[np.float64]

_STEPS = 100
_CONVERGED = 1e-9
_STARTS = 20
"""Further starts of the least squares at most."""
_FITS = 1e-3
"""Root mean square of the residuals below which no other layout fits better, m: far below the error of ranges."""
_SCATTER = 0.7
"""Standard deviation of these around the first one, as a share of the layout's own."""
_STIFF = 1e-4
"""Smallest share of the largest singular value with which a layout is rigid."""


@frozen
class Layout:
    """Anchors in a plane."""

    places: Places
    """The anchors' places by address, m."""
    residuals: dict[Pair, float]
    """Measured minus computed distance, m."""

    @property
    def rms(self) -> float:
        """Root of the mean squared residual, m."""
        return math.sqrt(math.fsum(r * r for r in self.residuals.values()) / len(self.residuals))

    @property
    def redundant(self) -> bool:
        """Return whether there are more distances than places need, so that residuals show errors."""
        return len(self.residuals) > 2 * len(self.places) - 3


def locate(distances: Mapping[Pair, float], heights: Mapping[str, float] | None = None) -> Layout:
    """Return the layout that fits the distances (m) best, the first anchor at the origin, the second on the x axis, the
    third above it, as the phone app lays them. Both directions of a pair are averaged. Raises `LocalError` where they
    do not fix a layout.
    """
    names = list(dict.fromkeys(name for pair in distances for name in pair))
    pairs = _flat(distances, names, heights or {})
    if len(names) < 3:
        raise LocalError(f"{len(names)} anchors: three are needed to lay out a plane")
    found = _searched(scaled(_filled(pairs, len(names))), pairs)
    _check_stiffness(found, pairs, names)
    places = _first_on_axes(found)
    named = {name: (float(x), float(y)) for name, (x, y) in zip(names, places, strict=True)}
    residuals = {(names[i], names[j]): d - math.dist(places[i], places[j]) for (i, j), d in pairs.items()}
    return Layout(named, residuals)


def align(layout: Layout, known: Mapping[str, tuple[float, float]]) -> Layout:
    """Return the layout moved, turned and, if that fits better, mirrored onto places that are known roughly (Kabsch
    1976)."""
    names = [name for name in layout.places if name in known]
    if len(names) < 2:
        raise LocalError(f"{len(names)} of the anchors have a known place: two or more are needed to align them")
    here, there = (np.array([table[name] for name in names]) for table in (layout.places, known))
    u, _, v = np.linalg.svd((here - here.mean(0)).T @ (there - there.mean(0)))
    turn = u @ v
    if len(names) == 2 and np.linalg.det(turn) < 0:  # two places do not tell a mirror image
        turn = u @ np.diag([1.0, -1.0]) @ v
    moved = {
        name: tuple(map(float, (np.array(place) - here.mean(0)) @ turn + there.mean(0)))
        for name, place in layout.places.items()
    }
    return Layout({name: (x, y) for name, (x, y) in moved.items()}, layout.residuals)


def _flat(
    distances: Mapping[Pair, float], names: Sequence[str], heights: Mapping[str, float]
) -> dict[tuple[int, int], float]:
    """Horizontal distance by indices of a pair, both directions averaged."""
    both: dict[tuple[int, int], list[float]] = {}
    for (one, other), distance in distances.items():
        i, j = sorted((names.index(one), names.index(other)))
        if i == j or not (math.isfinite(distance) and distance > 0):
            raise LocalError(f"distance from {one} to {other} of {distance} m")
        climb = heights.get(one, 0.0) - heights.get(other, 0.0)
        if distance <= abs(climb):
            raise LocalError(f"{distance:.2f} m from {one} to {other}, whose heights differ by {abs(climb):.2f} m")
        both.setdefault((i, j), []).append(math.sqrt(distance**2 - climb**2))
    return {pair: math.fsum(values) / len(values) for pair, values in sorted(both.items())}


def _filled(pairs: Mapping[tuple[int, int], float], count: int) -> Array:
    """Return the matrix of all distances; those not measured are the shortest path (Floyd, Warshall)."""
    matrix = np.full((count, count), np.inf)
    np.fill_diagonal(matrix, 0.0)
    for (i, j), distance in pairs.items():
        matrix[i, j] = matrix[j, i] = distance
    for k in range(count):
        matrix = np.minimum(matrix, matrix[:, k, None] + matrix[None, k, :])
    if not np.isfinite(matrix).all():
        raise LocalError("the anchors fall into groups with no distance measured between them")
    return matrix


def scaled(matrix: Array) -> Array:
    """Return places in the plane, of shape (count, 2), whose distances are near those of the matrix: classical
    scaling."""
    count = len(matrix)
    centre = np.eye(count) - 1.0 / count
    values, vectors = np.linalg.eigh(-0.5 * centre @ matrix**2 @ centre)
    result: Array = vectors[:, -2:] * np.sqrt(np.maximum(values[-2:], 1e-12))
    return result


def _searched(start: Array, pairs: Mapping[tuple[int, int], float]) -> Array:
    """Return the places of least squares. Where there are no more distances than places need, several layouts fit
    exactly: then the one next to `start`."""

    def error(places: Array) -> float:
        return float(np.sqrt(np.mean(_linear(places, pairs)[1] ** 2)))

    numbers = np.random.default_rng(0)
    scatter = _SCATTER * float(start.std())
    found = _refined(start, pairs)
    for _ in range(_STARTS if len(pairs) > start.size - 3 else 0):
        if error(found) < _FITS:
            break
        found = min(found, _refined(start + numbers.normal(scale=scatter, size=start.shape), pairs), key=error)
    return found


def _refined(places: Array, pairs: Mapping[tuple[int, int], float]) -> Array:
    """Gauss-Newton on the measured distances; the free motions of the whole take no part (least norm)."""
    for _ in range(_STEPS):
        jacobian, error = _linear(places, pairs)
        step = np.linalg.lstsq(jacobian, error, rcond=1e-6)[0].reshape(places.shape)
        places = places + step
        if np.abs(step).max() < _CONVERGED:
            break
    return places


def _linear(places: Array, pairs: Mapping[tuple[int, int], float]) -> tuple[Array, Array]:
    jacobian = np.zeros((len(pairs), places.size))
    error = np.empty(len(pairs))
    for row, ((i, j), measured) in enumerate(pairs.items()):
        way = places[i] - places[j]
        distance = max(float(np.linalg.norm(way)), 1e-9)
        error[row] = measured - distance
        jacobian[row, 2 * i : 2 * i + 2] = way / distance
        jacobian[row, 2 * j : 2 * j + 2] = -way / distance
    return jacobian, error


def _check_stiffness(places: Array, pairs: Mapping[tuple[int, int], float], names: Sequence[str]) -> None:
    """Three motions of the whole are free (two shifts, one turn); any further one leaves the layout open."""
    jacobian, _ = _linear(places, pairs)
    values = np.linalg.svd(jacobian, compute_uv=False)
    stiff = int((values > _STIFF * values[0]).sum())
    if stiff < 2 * len(names) - 3:
        text = f"{len(pairs)} distances between {len(names)} anchors do not fix their places"
        raise LocalError(f"{text}: too few pairs were measured, or all anchors lie in a line")


def _first_on_axes(places: Array) -> Array:
    moved: Array = places - places[0]
    x, y = moved[1]
    length = math.hypot(x, y)
    if length < 1e-6:
        raise LocalError("the first two anchors are at one place")
    moved = np.array(moved @ np.array([[x, -y], [y, x]]) / length)
    if moved[2, 1] < 0:
        moved[:, 1] *= -1
    return moved
