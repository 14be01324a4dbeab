"""Conversion of a velocity in the plane to the commands of a robot with two wheels: speed ahead and turn rate."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from services.apps.core.avoidance import Barrier, Point, allowed_speed, way_round


class UnicyclePose(NamedTuple):
    """The pose of a robot: m, rad counter-clockwise from x."""

    x: float
    y: float
    heading: float


class UnicycleLimits(NamedTuple):
    """The limits of what is commanded. They are below what a robot can do, so it balances quietly."""

    speed: float = 0.2
    """m/s."""
    turn_rate: float = 1.5
    """rad/s."""
    turn_gain: float = 3.0
    """rad/s for each rad between heading and wished direction."""


def drive(
    pose: UnicyclePose, wish: Point, others: Sequence[Point], barrier: Barrier, limits: UnicycleLimits
) -> tuple[float, float]:
    """Speed (m/s) and turn rate (rad/s) towards the wished velocity (m/s), past `others` and safe from them.

    It drives backwards rather than turn by more than 90 degrees.
    """
    place = (pose.x, pose.y)
    u = way_round(place, wish, others, barrier, limits.speed)
    pace = math.hypot(*u)
    if pace < 1e-6:
        return allowed_speed(place, pose.heading, 0.0, others, barrier, limits.speed), 0.0
    off = math.remainder(math.atan2(u[1], u[0]) - pose.heading, math.tau)
    backwards = abs(off) > math.pi / 2
    if backwards:
        off = math.remainder(off + math.pi, math.tau)
    speed = math.copysign(pace * math.cos(off), -1.0 if backwards else 1.0)
    # A slow wish has an uncertain direction: the noise of the poses shall not turn the robot about.
    turn = limits.turn_gain * off * min(1.0, pace / (0.25 * limits.speed))
    turn = max(-limits.turn_rate, min(limits.turn_rate, turn))
    return allowed_speed(place, pose.heading, speed, others, barrier, limits.speed), turn
