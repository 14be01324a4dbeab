"""Lying down: tip over to the front, and brake the fall by driving after it.

The wheels push the body back while they speed up; backward at first gives them more speed to gain. How fast it touches
the floor in simulation: docs/reference/robot/balancer.md, section Modes.
"""

import math

from services.balancer.core.control.estimation.estimator import BodyEstimate
from services.balancer.core.control.estimation.posture import lies

TIP_DUTY = -0.4
TIPPED = math.radians(40)
"""Backward until it leans so far: the body tips forward, and the wheels have more speed to gain."""
FALL_RATE = 3.0
"""rad/s that it shall fall with."""
BRAKE_GAIN = 0.5
"""Duty a rad/s above that."""
DOWN = math.radians(107)
"""The tilt from which on the motors are off: the floor, at 110 degrees, does the rest."""
LONGEST_S = 2.0
"""Whatever it does then, the motors are off."""


class LieDown:
    """One order to lie down, from balancing."""

    def __init__(self, now: float) -> None:
        self._since = now
        self._tipped = self._down = False
        self.done = False
        """Whether it is over, motors off."""

    def step(self, estimate: BodyEstimate) -> float:
        """Duty of both motors for this tick; look at `done` afterwards."""
        passed = estimate.t - self._since
        self._down |= abs(estimate.tilt) > DOWN or passed > LONGEST_S
        if self._down:
            self.done = lies(estimate.tilt, estimate.tilt_rate) or passed > 2 * LONGEST_S
            return 0.0
        self._tipped |= estimate.tilt > TIPPED
        if not self._tipped:
            return TIP_DUTY
        return min(1.0, max(0.0, BRAKE_GAIN * (estimate.tilt_rate - FALL_RATE)))
