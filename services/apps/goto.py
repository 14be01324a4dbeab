"""Each robot drives along its waypoints, past the others. docs/apps/goto.md."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from services.apps.driving import DrivingApp
from swarm import parameter
from swarm.codec import Value
from swarm.errors import AppError

SLOWING = 1.0
"""1/s: within speed / SLOWING of a waypoint the robot slows down in proportion."""


class Goto(DrivingApp):
    """Towards the waypoint at `speed`, with the velocity nearest to that which keeps `apart` from all."""

    waypoints: str = parameter("")
    """x,y x,y ... in m, in the frame of the anchors; empty: the place opposite, by the middle between the anchors."""
    reach: float = parameter(0.06, unit="m", low=0.02, high=1.0)
    """How near it has to come."""
    reached: int = 0
    """Waypoints so far."""
    _goals: tuple[tuple[float, float], ...] = ()

    def start(self) -> None:
        """Read the waypoints."""
        super().start()
        self._goals = read_waypoints(self.waypoints)

    def step(self, neighbours: Sequence[Any]) -> None:
        """One look, one command."""
        here = self.look(neighbours)
        if here is not None and not self._goals:
            self._goals = (self._opposite(here),)
        if here is None or self.reached >= len(self._goals):
            self.go((0.0, 0.0))
            return
        x, y = self._goals[self.reached]
        left = math.dist(here, (x, y))
        if left < self.reach:
            self.reached += 1
            self.robot.record("reached", self.reached)
            self.robot.log.info("waypoint %d reached", self.reached)
            self.go((0.0, 0.0))
            return
        pace = min(self.speed, SLOWING * left) / left
        self.go((pace * (x - here[0]), pace * (y - here[1])))

    def _opposite(self, here: tuple[float, float]) -> tuple[float, float]:
        anchors = self.robot.anchors
        if not anchors:
            raise AppError("waypoints: there are none, and no anchors between which a place could be opposite")
        xs, ys = [anchor.x for anchor in anchors], [anchor.y for anchor in anchors]
        return min(xs) + max(xs) - here[0], min(ys) + max(ys) - here[1]

    def result(self) -> Mapping[str, Value]:
        """Its place (m), how many others it knows, and waypoints reached."""
        return {**self.told(), "reached": self.reached, "of": len(self._goals)}


def read_waypoints(text: str) -> tuple[tuple[float, float], ...]:
    """ "0.5,1.5 1,1" as points, m; raises `AppError`."""
    points = []
    for word in text.split():
        try:
            x, y = map(float, word.split(","))
        except ValueError:
            raise AppError(f'waypoints: expected "x,y x,y ..." in m, got {word!r}') from None
        if not (math.isfinite(x) and math.isfinite(y)):
            raise AppError(f"waypoints: {word!r} is no place")
        points.append((x, y))
    return tuple(points)
