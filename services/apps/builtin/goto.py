"""The app `goto`: each robot drives along its waypoints, past the others. docs/reference/apps/goto.md."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from services.apps.builtin.driving import DrivingApp
from services.apps.core.avoidance import Point
from swarm import parameter
from swarm.errors import AppError
from swarm.messages.codec import Value

SLOWING = 1.0
"""1/s: within speed / SLOWING of a waypoint the robot slows down in proportion."""

STAY = "stay"

MOST = 63
"""The most robots: each has one bit."""


class Goto(DrivingApp):
    """Towards the waypoint at `speed`, with the velocity nearest to that which keeps `apart` from all."""

    waypoints: str = parameter("")
    """x,y x,y ... in m, in the frame of the anchors; empty: the place opposite, by the middle between the anchors. The
    word `stay` at the end: the robot stands there, or where it is, and goto goes on for further waypoints."""
    reach: float = parameter(0.06, unit="m", low=0.02, high=1.0)
    """Distance to a waypoint at which it counts as reached."""
    arrived: int = 0
    """A bit for each robot, in the order of swarm.toml, of which is known that it has reached its last waypoint."""
    _goals: tuple[Point, ...] = ()
    _reached: int = 0
    _stays: bool = False
    """Whether it is not done when it has arrived."""

    def start(self) -> None:
        """Read the waypoints."""
        super().start()
        self._goals, self._stays = read_waypoints(self.waypoints)
        if len(self.robot.swarm) > MOST:
            raise AppError(f"goto has room for {MOST} robots, the swarm has {len(self.robot.swarm)}: use fewer robots")

    def on_parameter(self, name: str) -> None:
        """New waypoints take the place of all old ones. Text that names no places changes nothing, and the robot's
        display says so."""
        if name != "waypoints":
            return
        try:
            self._goals, self._stays = read_waypoints(self.waypoints)
            self._reached = 0
        except AppError:
            self.robot.display("waypoints", "not read")

    def step(self, neighbours: Sequence[Any]) -> None:
        """Command the velocity towards the next waypoint; finish when all robots have arrived. A robot that has
        arrived gives way to others until then. A robot that gets new waypoints after its arrival drives there first."""
        here = self.look(neighbours)
        self.go((0.0, 0.0) if here is None else self._wish(here))
        for neighbour in neighbours:
            self.arrived |= neighbour.arrived
        if self._goals and self._reached == len(self._goals) and not self._stays:
            self.arrived |= 1 << self.robot.swarm.index(self.robot.name)
        arrived = self._reached == len(self._goals)
        if arrived and not self._stays and self.arrived == (1 << len(self.robot.swarm)) - 1:
            self.finish("all have arrived")

    def _wish(self, here: Point) -> Point:
        if not self._goals and not self._stays:
            self._goals = (self._opposite(here),)
        if self._reached < len(self._goals) and math.dist(here, self._goals[self._reached]) < self.reach:
            self._reached += 1
            self.robot.record("reached", self._reached)
        if not self._goals:
            return 0.0, 0.0
        x, y = self._goals[min(self._reached, len(self._goals) - 1)]
        left = math.dist(here, (x, y))
        self.robot.record("off", left)
        if self._reached == len(self._goals) or left == 0.0:
            return 0.0, 0.0
        pace = min(self.speed, SLOWING * left) / left
        return pace * (x - here[0]), pace * (y - here[1])

    def _opposite(self, here: Point) -> Point:
        anchors = self.robot.anchors
        if not anchors:
            raise AppError("waypoints: none are given, and there are no anchors whose middle the robot could cross")
        xs, ys = [anchor.x for anchor in anchors], [anchor.y for anchor in anchors]
        return min(xs) + max(xs) - here[0], min(ys) + max(ys) - here[1]

    def result(self) -> Mapping[str, Value]:
        """Return the robot's place (m), how many others it knows, and the number of waypoints reached."""
        return {**self.told(), "reached": self._reached, "of": len(self._goals)}


def read_waypoints(text: str) -> tuple[tuple[Point, ...], bool]:
    """Return "0.5,1.5 1,1 stay" as points, m, and whether there is a `stay` at the end; raises `AppError`."""
    points = []
    words = text.split()
    stays = words[-1:] == [STAY]
    for word in words[:-1] if stays else words:
        try:
            x, y = map(float, word.split(","))
        except ValueError:
            raise AppError(f'waypoints: expected "x,y x,y ..." in m, got {word!r}') from None
        if not (math.isfinite(x) and math.isfinite(y)):
            raise AppError(f"waypoints: {word!r}: expected finite numbers, in m")
        points.append((x, y))
    return tuple(points), stays
