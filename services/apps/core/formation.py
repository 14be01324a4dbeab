"""A formation by consensus on relative positions, and the shapes there are.

With p_i where robot i is and d_i its place in the shape, all agree on p_i - d_i, the shape's origin, which each sees
through its own place:

    p_i' = (g / n) sum_j ((p_j - d_j) - (p_i - d_i))

over the n - 1 robots it knows of. Only differences of places enter. Where all know all, the mean of the places stays
where it was, and the error falls as exp(-g t) (Olfati-Saber, Fax, Murray, Proc. IEEE 95, 2007; Ren, Beard 2008, ch. 5).
"""

import math
from collections.abc import Iterable

from services.apps.core.avoidance import Point

SHAPES = ("circle", "line", "wedge")
"""The shapes of a formation, the default first."""
SIZE = 0.6
"""m."""


def offset(shape: str, number: int, count: int, size: float) -> Point:
    """Place of robot `number` of `count` in the shape, m; `size` is a circle's radius, or the distance in a row."""
    if shape == "circle":
        angle = math.tau * number / count
        return size * math.cos(angle), size * math.sin(angle)
    along = number - (count - 1) / 2
    if shape == "line":
        return size * along, 0.0
    return size * along, -size * abs(along)


def error(here: Point, mine: Point, others: Iterable[tuple[Point, Point]]) -> Point:
    """Return the law's sum over n: how far this robot's view of the origin is from the mean of all, m. `mine` is its
    offset, `others`: place and offset of each."""
    x = y = 0.0
    n = 1
    for place, place_in_shape in others:
        x += place[0] - place_in_shape[0] - here[0] + mine[0]
        y += place[1] - place_in_shape[1] - here[1] + mine[1]
        n += 1
    return x / n, y / n
