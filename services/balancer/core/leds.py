"""What the three LEDs show: the balancer's state, unless an app claimed them for a while.

| lamps                        | meaning                                                    |
|------------------------------|------------------------------------------------------------|
| all off                      | idle: motors off                                           |
| yellow, blinking twice a s   | calibrating: leave it alone                                |
| yellow                       | starting, standing up or lying down                        |
| green                        | balancing                                                  |
| red                          | fault, through any claim                                   |
| red and yellow               | fault: stopped by `swarm/stop`, through any claim          |
| red flash every 2 s          | battery low, on top of everything else                     |
"""

from services.balancer.core.controller import BALANCING, CALIBRATING, FAULT, LYING_DOWN, STANDING_UP, STARTING
from services.balancer.core.faults import STOPPED

Shown = tuple[bool, bool, bool]
"""Red, yellow, green."""

CLAIM_S = 3.0
"""An app's claim ends so long after its last message, as the lamps of the original system did."""
LONGEST_CLAIM_S = 60.0

_BLINK_S = 0.25
_FLASH_EVERY_S, _FLASH_S = 2.0, 0.15


def shown(mode: str, fault: str, claim: Shown | None, *, low_battery: bool, now: float) -> Shown:
    """The LEDs for this moment; `fault` is its name in mode fault."""
    if mode == FAULT:
        return True, fault == STOPPED, False
    lamps = claim if claim is not None else _own(mode, now)
    if low_battery and now % _FLASH_EVERY_S < _FLASH_S:
        return True, lamps[1], lamps[2]
    return lamps


def _own(mode: str, now: float) -> Shown:
    if mode == CALIBRATING:
        return False, now % (2 * _BLINK_S) < _BLINK_S, False
    return False, mode in (STARTING, STANDING_UP, LYING_DOWN), mode == BALANCING
