"""The common part of apps that drive: the own pose, the others' places, and commands that avoid the others."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from services.apps.core import places, unicycle
from services.apps.core.avoidance import Barrier, Point
from swarm import Matrix, PeriodicApp, parameter
from swarm.errors import AppError
from swarm.messages.codec import Value

SEEK_SPEED, SEEK_TURN = 0.1, 0.8
"""A circle of 12 cm: UWB ranges tell the heading of a robot only while it moves."""
SEEK_S = 60.0
"""Seconds in a circle after which the heading must be known. With four anchors it is within 4 s."""


class DrivingApp(PeriodicApp):
    """Base of apps in which each robot drives among the others. A step calls `go`."""

    table: Annotated[Matrix, places.ROWS, places.COLUMNS]
    """What this robot knows of where all are, as `services.apps.core.places` has it."""
    speed: float = parameter(0.2, unit="m/s", low=0.02, high=0.5)
    apart: float = parameter(0.30, unit="m", low=0.16, high=2.0)
    """What the robots keep between their axles, as far as their poses are right."""
    _places: places.Places
    _velocity: Point = (0.0, 0.0)
    _sought: float = 0.0
    """Seconds for which it has looked for its heading."""

    def start(self) -> None:
        """Begin without the place of any robot."""
        self._places = places.Places(self.robot.swarm.index(self.robot.name), len(self.robot.swarm))
        self.table = self._places.tell(self.robot.now)

    def look(self, neighbours: Sequence[Any]) -> Point | None:
        """Take what the neighbours tell, tell it on, and say where this robot is; None where it does not know."""
        now = self.robot.now
        for neighbour in neighbours:
            self._places.hear(neighbour.table, neighbour.age, now)
        pose = self.robot.pose
        if pose is not None:
            self._places.be((pose.x, pose.y), self._velocity, pose.age, now)
        self.table = self._places.tell(now)
        return None if pose is None else (pose.x, pose.y)

    def others(self) -> dict[str, Point]:
        """Return the places of other robots, m, by name."""
        return {self.robot.swarm[number]: place for number, place in self._places.others(self.robot.now).items()}

    def go(self, wish: Point) -> None:
        """Drive with the velocity `wish` (m/s) as far as the wheels can, and past the others.

        A robot that does not know its heading finds it by a small circle; one that does not stand, or does not know its
        place, does nothing.
        """
        pose = self.robot.pose
        self._velocity = (0.0, 0.0)
        if pose is None or self.robot.posture != "standing":
            self.robot.drive(0.0, 0.0)
            return
        if pose.heading is None:
            self._sought += self.period
            if self._sought > SEEK_S:
                raise AppError(
                    f"the heading is still unknown after {SEEK_S:g} s in a circle: [dwm] filter must be auto or ekf, "
                    "and reports of another source need a heading"
                )
            self.robot.drive(SEEK_SPEED, SEEK_TURN)
            return
        self._sought = 0.0
        here = unicycle.UnicyclePose(pose.x, pose.y, pose.heading)
        barrier = Barrier(self.apart)
        speed, turn = unicycle.drive(
            here, wish, list(self.others().values()), barrier, unicycle.UnicycleLimits(speed=self.speed)
        )
        self._velocity = (speed * math.cos(here.heading), speed * math.sin(here.heading))
        self.robot.drive(speed, turn)

    def told(self) -> Mapping[str, Value]:
        """Return the common part of `result`: the robot's place in m (-1000 where it is unknown), and how many
        others it knows."""
        pose = self.robot.pose
        return {
            "x": -1000.0 if pose is None else pose.x,
            "y": -1000.0 if pose is None else pose.y,
            "known": len(self.others()),
        }
