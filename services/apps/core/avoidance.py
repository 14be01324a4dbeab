"""Collision avoidance among robots that drive like unicycles: control barrier functions, each robot half of it.

For two robots at p_i and p_j let h = |p_i - p_j|^2 - D^2: as long as it is positive they are more than D apart. If each
keeps to

    2 (p_i - p_j) . u_i >= -(a/2) h                                                                (1)

with its velocity u_i, then h' >= -a h, and h, once positive, stays so (Wang, Ames, Egerstedt, IEEE Trans. Robotics 33,
2017; Ames et al., ECC 2019). (1) is a half-plane of velocities. Two things follow from it:

- `way_round`: the velocity nearest to the wished one that (1) allows for all others: it tells where to turn. Where
  somebody stands in the way, the wish is first turned to the right: all give way to the same side, and nobody waits
  for somebody who waits.
- `allowed_speed`: a unicycle moves along its heading only, so its speed alone decides (1). Standing still always
  satisfies it: whatever the heading does, no robot ever has to move to be safe, and none is hit by one that keeps (1).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

Point = tuple[float, float]


ABEAM = 3.0
"""Another one is nearly abeam where the speed towards it is less than the wished one divided by this: 19 degrees."""


class Barrier(NamedTuple):
    """The distances that the avoidance keeps."""

    distance: float = 0.30
    """D, m, between axles: robots touch at 0.15; the rest is for errors of poses, sway and the way of stopping."""
    rate: float = 2.0
    """a, 1/s: how fast the room above D may be used up."""
    right: float = 1.0
    """Share of the wished speed added to the right where somebody is in the way."""

    def least(self, place: Point, other: Point) -> float:
        """Return the least (p_i - p_j) . u_i, m^2/s."""
        return -self.rate / 4 * (math.dist(place, other) ** 2 - self.distance**2)


class _HalfPlane(NamedTuple):
    """Velocities u with (x, y) . u >= least."""

    x: float
    y: float
    least: float

    def room(self, u: Point) -> float:
        return self.x * u[0] + self.y * u[1] - self.least


def way_round(place: Point, wish: Point, others: Sequence[Point], barrier: Barrier, speed: float) -> Point:
    """Return the allowed velocity nearest to `wish`, m/s, at most `speed` fast; `others` are where the other robots
    are."""
    planes = [_half_plane(place, other, barrier) for other in others]
    x, y = wish = _at_most(wish, speed)
    pace = math.hypot(x, y)
    for plane in planes:
        if plane.room(wish) < 0.0:  # the other one is ahead and near: pass it on its right
            length = math.hypot(plane.x, plane.y)
            towards = -(wish[0] * plane.x + wish[1] * plane.y) / length
            # Less where it is nearly abeam: else a robot that is nearly past one that stands would want to turn about
            # and go round it on the other side, and the two wishes would cancel.
            share = barrier.right * max(0.0, min(pace, ABEAM * towards)) / length
            x -= share * plane.y
            y += share * plane.x
    return _at_most(_nearest((x, y), planes), speed)


def allowed_speed(
    place: Point, heading: float, speed: float, others: Sequence[Point], barrier: Barrier, limit: float
) -> float:
    """Return the speed along `heading` nearest to `speed` that (1) allows, m/s; at most `limit` either way.

    Where robots are nearer than D already it drives away from them, and stands where it cannot drive away from all.
    """
    low, high = -limit, limit
    c, s = math.cos(heading), math.sin(heading)
    for other in others:
        along = (place[0] - other[0]) * c + (place[1] - other[1]) * s
        least = barrier.least(place, other)
        if along > 0.0:
            low = max(low, least / along)
        elif along < 0.0:
            high = min(high, least / along)
    if low > high:
        return 0.0
    return max(-limit, min(limit, high, max(low, speed)))


def _at_most(u: Point, speed: float) -> Point:
    pace = math.hypot(*u)
    return u if pace <= speed else (u[0] * speed / pace, u[1] * speed / pace)


def _half_plane(place: Point, other: Point, barrier: Barrier) -> _HalfPlane:
    x, y = place[0] - other[0], place[1] - other[1]
    if math.hypot(x, y) < 1e-3:  # poses that say the same place: any direction will do
        x, y = 1e-3, 0.0
    return _HalfPlane(x, y, barrier.least(place, other))


def _nearest(wish: Point, planes: Sequence[_HalfPlane]) -> Point:
    """Projection of `wish` onto the intersection of half-planes; in the plane the optimum of this quadratic programme
    is the wish, its foot on one of the lines, or where two of them cross. Where there is none: the candidate that is
    violated least."""
    if all(plane.room(wish) >= -1e-9 for plane in planes):
        return wish
    candidates = [wish]
    for n, a in enumerate(planes):
        square = a.x * a.x + a.y * a.y
        step = a.room(wish) / square
        candidates.append((wish[0] - step * a.x, wish[1] - step * a.y))
        for b in planes[:n]:
            cross = a.x * b.y - a.y * b.x
            if abs(cross) > 1e-9:
                candidates.append(((a.least * b.y - b.least * a.y) / cross, (b.least * a.x - a.least * b.x) / cross))
    allowed = [u for u in candidates if all(plane.room(u) >= -1e-9 for plane in planes)]
    if allowed:
        return min(allowed, key=lambda u: math.dist(u, wish))
    return max(candidates, key=lambda u: min(plane.room(u) for plane in planes))
