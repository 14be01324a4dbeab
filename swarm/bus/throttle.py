"""`KEY/throttled`: a copy of a fast key with few of its messages, for subscribers that need a lower rate.

Most of what a message costs is waking its sender, the bus and its receiver. A copy without subscribers costs nothing.
"""

from swarm.bus.protocol import BusLike

THROTTLED = "throttled"
"""The last chunk of a throttled copy's key."""

APP_STATE_S = 0.5
"""Seconds between two messages of the throttled copy of an app's state; a display needs no more."""


class Throttle:
    """Publishes the throttled copy of one key."""

    def __init__(self, bus: BusLike, key: str, period: float) -> None:
        """`period`: s between two messages."""
        self._bus = bus
        self._key = f"{key}/{THROTTLED}"
        self._period = period
        self._due = float("-inf")

    def publish(self, message: object, t: float, *, news: bool = False, urgent: bool = False) -> bool:
        """Take a message of time `t`, and publish it where one is due, or where it is `news`; says whether it did."""
        if t >= self._due:
            # From when it was due, not from now: a period need not be a multiple of the fast key's.
            self._due = max(self._due, t - self._period) + self._period
        elif not news:
            return False
        self._bus.publish(self._key, message, urgent=urgent)
        return True
