"""The places of all robots, passed on from neighbour to neighbour with the age of the news.

Each robot tells its neighbours its own place and velocity and the newest it knows of others; a neighbour's neighbour's
place is a period and a link's delay older for each hop. Ages travel instead of times: no common clock is needed, and
only the time on the air is left out (some 30 ms a hop, at 0.2 m/s 6 mm).
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from services.apps.core.avoidance import Point

ROWS = 9
"""Robots in a message: the own place first, then those nearest to it."""
COLUMNS = 6
"""Number of the robot (-1: an empty row), x, y (m), velocity in x and y (m/s), age (s)."""
AHEAD_S = 1.0
"""Seconds for which a place is continued with its velocity. After that the robot counts as standing."""
FORGET_S = 30.0

Row = tuple[float, ...]
EMPTY: Row = (-1.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class _Seen(NamedTuple):
    t: float
    x: float
    y: float
    vx: float
    vy: float

    def at(self, now: float) -> Point:
        dt = min(AHEAD_S, max(0.0, now - self.t))
        return self.x + self.vx * dt, self.y + self.vy * dt


class Places:
    """The places of other robots that one robot knows. Times are of its own clock, s; a robot is named by its index
    in the swarm."""

    def __init__(self, me: int, robots: int) -> None:
        """`robots`: how many there are in the swarm."""
        self._me = me
        self._robots = robots
        self._seen: dict[int, _Seen] = {}

    def be(self, place: Point, velocity: Point, age: float, now: float) -> None:
        """The own place was this, `age` s ago."""
        self._seen[self._me] = _Seen(now - age, *place, *velocity)

    def hear(self, rows: Iterable[Row], age: float, now: float) -> None:
        """Take `rows` that a neighbour sent `age` s ago. The newest entry of each robot counts."""
        for row in rows:
            number, x, y, vx, vy, row_age = row
            if not (0 <= number < self._robots and all(map(math.isfinite, row))):
                continue
            robot, t = int(number), now - age - max(0.0, row_age)
            if robot == self._me:
                continue
            if robot not in self._seen or t > self._seen[robot].t:
                self._seen[robot] = _Seen(t, x, y, vx, vy)

    def tell(self, now: float) -> tuple[Row, ...]:
        """Return the rows for the neighbours: the own first, then the nearest; empty as long as the own place is
        unknown and nothing was heard."""
        self._forget(now)
        order: Sequence[int] = sorted(self._seen)
        if self._me in self._seen:
            here = self._seen[self._me].at(now)
            order = sorted(order, key=lambda robot: (robot != self._me, math.dist(self._seen[robot].at(now), here)))
        rows = [(float(robot), *self._seen[robot][1:], now - self._seen[robot].t) for robot in order[:ROWS]]
        return (*rows, *[EMPTY] * (ROWS - len(rows)))

    def others(self, now: float) -> dict[int, Point]:
        """Return the present places of the other robots, m, by index."""
        self._forget(now)
        return {robot: seen.at(now) for robot, seen in sorted(self._seen.items()) if robot != self._me}

    def _forget(self, now: float) -> None:
        self._seen = {robot: seen for robot, seen in self._seen.items() if now - seen.t < FORGET_S}
