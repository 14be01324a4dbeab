"""Contacts of robots: the pairs that come nearer than their bodies are wide, how hard they meet, and what each feels.

A body is a disc about its axle, whether it stands or lies. Two that overlap are moved apart, half the way each; the
speed with which they approach is taken out of both by an impulse, as between two bodies that do not spring back.
"""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from services.balancer.core.control.estimation.posture import UPRIGHT
from sim.core.actions import MAX_IMPULSE, Knock
from sim.core.track import Point

TOUCH_M = 0.15
"""Distance between axles at which two robots touch."""
APART_M = 0.17
"""Distance at which a contact is over. If the robots come nearer again, that is another contact."""
HIT_AGAIN_S = 0.03
"""Shortest time between two hits of one contact: bodies report every 0.04 s, and both need a report since the last."""
MOST_CONTACTS = 1000
"""The most contacts that are kept. Further ones are only counted."""
FALLS_WITHIN_S = 3.0
"""Seconds after a hit within which a fall counts as caused by it."""
_CELL_M = 1.0
"""Side of the squares in which robots are looked for that are near."""


class Closest(NamedTuple):
    """The least distance of two robots so far."""

    distance: float
    """m, between axles."""
    t: float
    a: str
    b: str


class Contact(NamedTuple):
    """Two robots have begun to touch."""

    t: float
    a: str
    b: str
    speed: float
    """Speed at which the robots met, m/s."""


class Hit(NamedTuple):
    """The effect of a contact on one robot."""

    robot: str
    impulse: Point
    """N s, along x and y."""
    shift: Point
    """The distance by which it is moved aside, m."""

    def knock(self, heading: float) -> Knock:
        """Return the effect on a body with this heading (rad): its part of the impulse forward. The wheels hold the
        part across."""
        along = self.impulse[0] * math.cos(heading) + self.impulse[1] * math.sin(heading)
        return Knock(max(-MAX_IMPULSE, min(MAX_IMPULSE, along)), *self.shift)


class _Body(NamedTuple):
    x: float
    y: float
    vx: float
    vy: float
    upright: bool
    held: bool


class Contacts:
    """Keeps where all robots are. Times are of one clock, s."""

    def __init__(self, masses: Mapping[str, float]) -> None:
        """`masses`: the mass of each robot, kg."""
        self._masses = masses
        self._bodies: dict[str, _Body] = {}
        self._cells: dict[tuple[int, int], list[str]] = {}
        self._touching: dict[tuple[str, str], float] = {}
        """Pairs that touch, and when they were hit last."""
        self._hit: dict[str, float] = {}
        """Robots that stood when they were hit last, and when that was."""
        self.closest: Closest | None = None
        self.contacts: list[Contact] = []
        """The first contacts, at most `MOST_CONTACTS`."""
        self.count = 0
        self.fallen: list[tuple[float, str]] = []
        """The robots that fell soon after a hit, with the times."""

    def pose(
        self, robot: str, t: float, place: Point, heading: float, speed: float, tilt: float, *, held: bool = False
    ) -> list[Hit]:
        """Take where a robot is (m, rad), how fast it drives (m/s) and how it leans (rad). Returns what it and others
        feel; one that is `held` in a hand, and whom it meets, feels nothing."""
        velocity = speed * math.cos(heading), speed * math.sin(heading)
        self._put(robot, _Body(*place, *velocity, abs(tilt) <= UPRIGHT, held))
        if abs(tilt) > UPRIGHT and (hit := self._hit.pop(robot, None)) is not None and t - hit <= FALLS_WITHIN_S:
            self.fallen.append((t, robot))
        hits = []
        for other in tuple(self._near(robot)):
            pair = (robot, other) if robot < other else (other, robot)
            distance = math.dist(place, self._bodies[other][:2])
            if self.closest is None or distance < self.closest.distance:
                self.closest = Closest(distance, t, *pair)
            if distance >= APART_M:
                self._touching.pop(pair, None)
            elif distance < TOUCH_M:
                hits += self._touch(t, pair)
        return hits

    def _touch(self, t: float, pair: tuple[str, str]) -> list[Hit]:
        approach = max(0.0, self._approach(*pair))
        if pair not in self._touching:
            self.count += 1
            if len(self.contacts) < MOST_CONTACTS:
                self.contacts.append(Contact(t, *pair, approach))
        elif t - self._touching[pair] < HIT_AGAIN_S:
            return []
        self._touching[pair] = t
        if any(self._bodies[robot].held for robot in pair):
            return []
        self._hit.update((robot, t) for robot in pair if self._bodies[robot].upright)
        return self._hits(*pair, approach)

    def _near(self, robot: str) -> Iterator[str]:
        """Yield the robots that may touch a robot, or be nearer to it than any two were."""
        if self.closest is None or self.closest.distance > _CELL_M:
            yield from (other for other in self._bodies if other != robot)
            return
        column, row = _cell(self._bodies[robot])
        for x in (column - 1, column, column + 1):
            for y in (row - 1, row, row + 1):
                yield from (other for other in self._cells.get((x, y), ()) if other != robot)

    def _put(self, robot: str, body: _Body) -> None:
        before = self._bodies.get(robot)
        cell = _cell(body)
        if before is None or _cell(before) != cell:
            if before is not None:
                self._cells[_cell(before)].remove(robot)
            self._cells.setdefault(cell, []).append(robot)
        self._bodies[robot] = body

    def _normal(self, robot: str, other: str) -> tuple[float, Point]:
        """Return the distance, and the direction from one robot to the other."""
        a, b = self._bodies[robot], self._bodies[other]
        distance = math.hypot(b.x - a.x, b.y - a.y)
        return distance, ((b.x - a.x) / distance, (b.y - a.y) / distance) if distance > 0.0 else (1.0, 0.0)

    def _approach(self, robot: str, other: str) -> float:
        """Return the speed at which two robots come nearer to each other, m/s."""
        _, (nx, ny) = self._normal(robot, other)
        a, b = self._bodies[robot], self._bodies[other]
        return (a.vx - b.vx) * nx + (a.vy - b.vy) * ny

    def _hits(self, robot: str, other: str, approach: float) -> list[Hit]:
        distance, (nx, ny) = self._normal(robot, other)
        half = (TOUCH_M - distance) / 2
        m, n = self._masses[robot], self._masses[other]
        impulse = approach * m * n / (m + n)
        hits = []
        for name, sign in ((robot, -1.0), (other, 1.0)):
            shift = (sign * half * nx, sign * half * ny)
            body = self._bodies[name]
            self._put(name, body._replace(x=body.x + shift[0], y=body.y + shift[1]))
            hits.append(Hit(name, (sign * impulse * nx, sign * impulse * ny), shift))
        return hits


def _cell(body: _Body) -> tuple[int, int]:
    return math.floor(body.x / _CELL_M), math.floor(body.y / _CELL_M)
