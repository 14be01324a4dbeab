"""The three LEDs: they show the balancer's state, unless an app has claimed them for a while; and the times of changes.

| lamps                        | meaning                                                    |
|------------------------------|------------------------------------------------------------|
| all off                      | idle: motors off                                           |
| yellow, blinking twice a s   | calibrating: leave it alone                                |
| yellow                       | starting, standing up, lying down, or testing motors       |
| green                        | balancing                                                  |
| red                          | fault, even while an app holds the LEDs                    |
| red and yellow               | stopped by `swarm/stop`, even while an app holds the LEDs  |
| red flash every 2 s          | battery low, in addition to the others but in a fault      |

An app's order may name the time from which it holds. It is written at that time, in the slack of a tick; where the
time falls into a control step, just before or just after that, whichever is nearer.
"""

import math
from typing import NamedTuple

from services.balancer.core.control.controller import (
    BALANCING,
    CALIBRATING,
    FAULT,
    LYING_DOWN,
    STANDING_UP,
    STARTING,
    TESTING,
)
from services.balancer.core.faults import STOPPED
from swarm.errors import LocalError
from swarm.messages.balancer import LONGEST_AHEAD_S

Shown = tuple[bool, bool, bool]
"""Red, yellow, green."""

CLAIM_S = 3.0
"""Seconds after its last message after which an app's claim ends, as in the original system."""
LONGEST_CLAIM_S = 60.0

MOST_AHEAD = 32
"""The most orders that wait for their time."""

WRITE_S = 0.7e-3
"""Seconds that the write takes on the bus. After it the LEDs have changed."""
MARGIN_S = 0.8e-3
"""Seconds that stay free before the next tick, whose control step must not be late."""
CONTROL_S = 3.4e-3
"""Seconds from a tick's time until its control step leaves the bus."""

_BLINK_S = 0.25
_FLASH_EVERY_S, _FLASH_S = 2.0, 0.15


def shown(mode: str, fault: str, claim: Shown | None, *, low_battery: bool, now: float) -> Shown:
    """Return the LEDs for this moment; `fault` is its name in mode fault."""
    if mode == FAULT:
        return True, fault == STOPPED, False
    lamps = claim if claim is not None else _own(mode, now)
    if low_battery and now % _FLASH_EVERY_S < _FLASH_S:
        return True, lamps[1], lamps[2]
    return lamps


def _own(mode: str, now: float) -> Shown:
    if mode == CALIBRATING:
        return False, now % (2 * _BLINK_S) < _BLINK_S, False
    return False, mode in (STARTING, STANDING_UP, LYING_DOWN, TESTING), mode == BALANCING


class LedOrder(NamedTuple):
    """An app's order for the LEDs, with its times, s."""

    leds: Shown
    at: float
    until: float


class LedClaim:
    """The app's orders: the one in force, and those whose time is to come."""

    def __init__(self) -> None:
        self._current: LedOrder | None = None
        self._coming: list[LedOrder] = []
        """The orders that wait, by time."""

    def take(self, order: LedOrder, now: float) -> bool:
        """Queue an order. It replaces earlier orders from `order.at` on. Return False where too many wait."""
        before = [other for other in self._coming if other.at < order.at]
        if order.at <= now:
            self._current = order
        elif len(before) < MOST_AHEAD:
            before.append(order)
        else:
            return False
        self._coming = before
        return True

    def order(self, leds: Shown, seconds: float, now: float, at: float | None) -> LedOrder:
        """Take an order from the time `at` on, or at once, and return it.

        Raises `LocalError` for a wrong time, or where too many orders wait for theirs.
        """
        if not 0.0 < seconds <= LONGEST_CLAIM_S:
            raise LocalError(f"leds: seconds: expected a time above 0 up to {LONGEST_CLAIM_S:g} s, got {seconds:.6g}")
        if at is not None and not at <= now + LONGEST_AHEAD_S:
            raise LocalError(f"leds: at: expected at most {LONGEST_AHEAD_S:g} s from now on, got {at - now:.6g}")
        begin = now if at is None else at
        order = LedOrder(leds, begin, begin + seconds)
        if not self.take(order, now):
            raise LocalError(f"leds: {MOST_AHEAD} orders wait for their time already")
        return order

    def clear(self) -> None:
        """The LEDs are the balancer's again, now and later."""
        self._current = None
        self._coming = []

    def leds(self, now: float) -> Shown | None:
        """Return the LEDs of the order at `now`; None without an order."""
        while self._coming and self._coming[0].at <= now:
            self._current = self._coming.pop(0)
        if self._current is not None and now >= self._current.until:
            self._current = None
        return None if self._current is None else self._current.leds

    @property
    def next_change(self) -> float:
        """Return the time at which the next order begins, s; infinity where none waits."""
        return self._coming[0].at if self._coming else math.inf


def moment(at: float, until: float) -> float | None:
    """Return when in this slack, which ends with the tick at `until`, to write LEDs that shall change at `at`.

    None: not in this slack. The transfer takes `WRITE_S`, so it begins that much earlier.
    """
    last = until - MARGIN_S - WRITE_S
    wish = at - WRITE_S
    if wish <= last:
        return wish
    return last if wish - last < until + CONTROL_S - wish else None
