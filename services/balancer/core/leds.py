"""What the three LEDs show: the balancer's mode, unless an app claimed them.

Red: fault. Yellow: starting or standing up. Green: balancing. None: idle. A claim holds until the next mode command; a
fault shows red through any claim.
"""

from services.balancer.core.controller import BALANCING, FAULT, STANDING_UP, STARTING

Shown = tuple[bool, bool, bool]
"""Red, yellow, green."""


def shown(mode: str, claim: Shown | None) -> Shown:
    """The LEDs for this moment."""
    if mode == FAULT:
        return True, False, False
    if claim is not None:
        return claim
    return False, mode in (STARTING, STANDING_UP), mode == BALANCING
