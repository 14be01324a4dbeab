"""The robot's posture, standing or lying, from its tilt alone: a robot on its back does not stand, whatever else is
true."""

import math

from services.balancer.core.control.estimation.estimator import BodyEstimate

UPRIGHT = math.radians(20)
"""Held within this angle it can be caught and balanced."""
LYING = (math.radians(85), math.radians(135))
"""Tilt of a robot that lies on its front or back, both near 110 degrees."""
LYING_RATE = math.radians(10)
REST_RATE = math.radians(3)
"""Above what a gyro shows whose zero is a degree a second off by temperature: that is what one calibrates for."""
REST_SPEED = 0.02


def posture(tilt: float, trim: float) -> str:
    """upright, front (lying on it), back, or leaning (anything else, as in somebody's hand or on its head)."""
    if abs(tilt - trim) < UPRIGHT:
        return "upright"
    if lies(tilt):
        return "front" if tilt > 0.0 else "back"
    return "leaning"


def lies(tilt: float, tilt_rate: float = 0.0) -> bool:
    """Return whether it lies on front or back, and does not move."""
    return LYING[0] < abs(tilt) < LYING[1] and abs(tilt_rate) < LYING_RATE


def at_rest(estimate: BodyEstimate) -> bool:
    """Return whether neither body nor wheels move: lying, or standing in a hand that is steady."""
    return (
        abs(estimate.tilt_rate) < REST_RATE and abs(estimate.speed) < REST_SPEED and abs(estimate.turn_rate) < REST_RATE
    )
