"""Robots drive into a formation that they agree on by relative positions. docs/reference/apps/formation.md."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from services.apps.builtin.driving import DrivingApp
from services.apps.core import formation
from swarm import parameter
from swarm.messages.codec import Value

REST_M = 0.015
"""Nearer than this to its place in the shape a robot rests; it goes on when it is `WAKE_M` off: the noise of poses
shall not keep it moving."""
WAKE_M = 0.035


class Formation(DrivingApp):
    """Consensus on the shape's origin, p_i' = (g / n) sum_j ((p_j - d_j) - (p_i - d_i)), d_i the place in the shape."""

    shape: str = parameter(formation.SHAPES[0], choices=formation.SHAPES)
    size: float = parameter(formation.SIZE, unit="m", low=0.1, high=10.0)
    """Radius of the circle; distance between neighbours in a line or wedge."""
    gain: float = parameter(1.0, unit="1/s", low=0.05, high=3.0)
    _off: float = 0.0
    _place: tuple[float, float] = (-1000.0, -1000.0)
    _resting: bool = False

    def step(self, neighbours: Sequence[Any]) -> None:
        """Command the velocity towards the place in the shape."""
        here = self.look(neighbours)
        if here is None:
            self.go((0.0, 0.0))
            return
        known = [(place, self._offset(name)) for name, place in self.others().items()]
        x, y = formation.error(here, self._offset(self.robot.name), known)
        self._off, self._place = math.hypot(x, y), (here[0] + x, here[1] + y)
        self._resting = self._off < (WAKE_M if self._resting else REST_M)
        self.go((0.0, 0.0) if self._resting else (self.gain * x, self.gain * y))
        self.robot.record("off", self._off)

    def _offset(self, name: str) -> tuple[float, float]:
        swarm = self.robot.swarm
        return formation.offset(self.shape, swarm.index(name), len(swarm), self.size)

    def result(self) -> Mapping[str, Value]:
        """Return the robot's place (m), how many others it knows, its distance from its place in the shape, and
        where that is, m."""
        return {**self.told(), "off": self._off, "goal_x": self._place[0], "goal_y": self._place[1]}
