"""Least squares of range residuals: Gauss-Newton from a start near the minimum, such as the closed form's."""

import math
from collections.abc import Sequence

Pair = tuple[float, float]

_STEPS = 20
_SETTLED = 1e-9  # m
_NEAREST = 1e-6  # m: at a robot's own place the residual has no slope


def refine(seen: Sequence[tuple[float, float, float]], start: Pair) -> Pair:
    """Return the minimum of sum (|x - p_i| - phi_i)^2 near `start`; `seen`: (phi, p_x, p_y) of each robot, m.

    A step that does not make the sum smaller is halved: what comes out is never worse than `start`.
    """
    place, cost = start, _cost(seen, start)
    for _ in range(_STEPS):
        xx = xy = yy = xe = ye = 0.0
        for distance, px, py in seen:
            dx, dy = place[0] - px, place[1] - py
            r = math.hypot(dx, dy) or _NEAREST
            ux, uy, error = dx / r, dy / r, distance - r
            xx, xy, yy = xx + ux * ux, xy + ux * uy, yy + uy * uy
            xe, ye = xe + ux * error, ye + uy * error
        determinant = xx * yy - xy * xy
        if determinant <= 1e-12:
            return place
        step = (yy * xe - xy * ye) / determinant, (xx * ye - xy * xe) / determinant
        while math.hypot(*step) > _SETTLED:
            there = (place[0] + step[0], place[1] + step[1])
            smaller = _cost(seen, there)
            if smaller < cost:
                place, cost = there, smaller
                break
            step = (step[0] / 2, step[1] / 2)
        else:
            return place
    return place


def _cost(seen: Sequence[tuple[float, float, float]], place: Pair) -> float:
    return math.fsum((math.dist(place, (px, py)) - distance) ** 2 for distance, px, py in seen)
