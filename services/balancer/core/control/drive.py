"""Driving: the place the robot holds, moved by velocity commands, and the heading, turned by them.

A command holds for the time it names; then, as when none ever came, the place comes to rest by the same ramp. So a
program that dies leaves a robot that stands.
"""

import math
from typing import NamedTuple

from services.balancer.core.control.body import BodyModel
from services.balancer.core.control.regulator import Demand, limited
from swarm.errors import LocalError

LONGEST_S = 10.0
"""A velocity command may hold so long at most: who drives for longer says so again."""

WAY_LAG = 0.25
"""m: a robot that cannot follow (held, blocked) is not left further behind than this while it drives."""
HEADING_LAG = math.radians(45)

HEADING_GAIN = 0.4
"""Duty a radian, added right and taken left: 11 rad/s of bandwidth, where motors and bus lag by 45 ms."""
HEADING_INTEGRAL = 0.4
"""Duty a radian and second, against dry friction: it alone would hold an error of two degrees."""
INTEGRAL_LIMIT = 0.05
TURN_LIMIT = 0.25
"""Duty: beside the 0.75 of balancing no motor gets more than all."""


class DriveLimits(NamedTuple):
    """The limits of driving."""

    speed: float
    """m/s."""
    turn_rate: float
    """rad/s."""
    acceleration: float
    """m/s^2."""
    turn_acceleration: float
    """rad/s^2."""


def check_command(speed: float, turn_rate: float, seconds: float) -> None:
    """Raises `LocalError` for a velocity command that cannot be meant: m/s, rad/s, and s for which it holds."""
    if not (math.isfinite(speed) and math.isfinite(turn_rate)):
        raise LocalError(f"velocity ({speed}, {turn_rate}) is not finite")
    if not 0.0 < seconds <= LONGEST_S:
        raise LocalError(f"velocity: seconds: expected a time above 0 up to {LONGEST_S:g} s, got {seconds:.6g}")


class Drive:
    """The moving set-point."""

    def __init__(self, body: BodyModel, limits: DriveLimits) -> None:
        self.limits = limits
        """May be replaced at any time."""
        self.heading_gain = HEADING_GAIN
        self._duty_per_turn_rate = body.track / 2 / body.wheel_radius / body.free_speed
        self.way = 0.0
        self.heading = 0.0
        self.speed = 0.0
        self.turn_rate = 0.0
        self._acceleration = 0.0
        self._wanted = (0.0, 0.0)
        self._until = -math.inf
        self._integral = 0.0

    @property
    def demand(self) -> Demand:
        """Motion of the place at this tick."""
        return Demand(self.speed, self._acceleration)

    def begin(self, way: float, heading: float) -> None:
        """Hold this place and heading; commands of before are void."""
        self.way, self.heading = way, heading
        self.speed = self.turn_rate = self._acceleration = self._integral = 0.0
        self._until = -math.inf

    def command(self, speed: float, turn_rate: float, until: float) -> str:
        """Go ahead at `speed` and turn left at `turn_rate` up to the time `until`. Returns what was cut, or ""."""
        limits = self.limits
        self._wanted = limited(speed, limits.speed), limited(turn_rate, limits.turn_rate)
        self._until = until
        cut = []
        if self._wanted[0] != speed:
            cut.append(f"speed {speed:.4g} is above the limit of {limits.speed:g} m/s")
        if self._wanted[1] != turn_rate:
            cut.append(f"turn rate {turn_rate:.4g} is above the limit of {limits.turn_rate:g} rad/s")
        return ", ".join(cut)

    def halt(self) -> None:
        """Come to rest: the command in force is void."""
        self._until = -math.inf

    def step(self, way: float, heading: float, now: float, dt: float) -> None:
        """Move the set-point on by one tick; `way` and `heading` are where the robot is."""
        speed, turn_rate = self._wanted if now < self._until else (0.0, 0.0)
        limits = self.limits  # they may have become narrower since the command
        speed, turn_rate = limited(speed, limits.speed), limited(turn_rate, limits.turn_rate)
        change = limited(speed - self.speed, limits.acceleration * dt)
        self._acceleration = change / dt if dt > 0.0 else 0.0
        self.speed += change
        self.turn_rate += limited(turn_rate - self.turn_rate, limits.turn_acceleration * dt)
        self.way += self.speed * dt
        self.heading += self.turn_rate * dt
        # At rest it holds its place however far it was carried; only a moving set-point waits for the robot.
        if self.speed != 0.0:
            self.way = way + limited(self.way - way, WAY_LAG)
        if self.turn_rate != 0.0:
            self.heading = heading + limited(self.heading - heading, HEADING_LAG)

    def turn(self, heading: float, dt: float) -> float:
        """Duty to add right and take left: feed-forward, and back to the heading the short way."""
        error = math.remainder(self.heading - heading, math.tau)
        self._integral = limited(self._integral + HEADING_INTEGRAL * error * dt, INTEGRAL_LIMIT)
        duty = self._duty_per_turn_rate * self.turn_rate + self.heading_gain * error + self._integral
        return limited(duty, TURN_LIMIT)
