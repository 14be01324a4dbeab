"""The estimate of heading and place: gyro and wheels together, integrated at every tick.

The gyro knows quick turns whatever the wheels do (slip, a robot that is lifted and put down), the wheels know that a
robot that goes straight does not turn: they teach the gyro its zero.
"""

import math

LEARNING_S = 10.0
"""Time constant with which the gyro's zero follows the wheels: what is left of it after the calibration, some 0.007
deg/s, costs 0.07 degrees in all."""
SMOOTHING_S = 0.5
"""Time constant that smooths the difference between the two: one count of one wheel in a tick is 0.17 rad/s."""
STRAIGHT = 0.1
"""rad/s: nothing is learned while either turns faster than that: a track 5 % wrong would be taken for a zero."""


class Heading:
    """Heading by both (`value`) and by the gyro alone (`gyro`), and the way in the plane (`x`, `y`)."""

    def __init__(self) -> None:
        self.value = 0.0
        """rad since the start, counter-clockwise, not wrapped."""
        self.gyro = 0.0
        self.x = 0.0
        """m, ahead of where it started."""
        self.y = 0.0
        """m, to the left."""
        self._zero = 0.0
        self._difference = 0.0
        self._wheel_rate = 0.0
        self._last_rate = 0.0

    def update(self, rate: float, wheel_turn: float, way: float, dt: float) -> None:
        """Take a tick's gyro rate about the vertical (rad/s), turn by the wheels (rad) and way (m)."""
        turned = dt * (rate + self._last_rate) / 2
        self._last_rate = rate
        self.gyro += turned
        turned -= self._zero * dt
        # The way of a tick is an arc: its chord points to the middle of the turn.
        middle = self.value + turned / 2
        self.x += way * math.cos(middle)
        self.y += way * math.sin(middle)
        self.value += turned
        if dt > 0.0:
            self._learn(turned / dt, wheel_turn / dt, dt)

    def _learn(self, by_gyro: float, by_wheels: float, dt: float) -> None:
        part = dt / (SMOOTHING_S + dt)
        self._difference += (by_gyro - by_wheels - self._difference) * part
        self._wheel_rate += (by_wheels - self._wheel_rate) * part
        if abs(self._wheel_rate) < STRAIGHT and abs(self._difference) < STRAIGHT:
            self._zero += self._difference * dt / LEARNING_S
