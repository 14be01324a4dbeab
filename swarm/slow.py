"""A fast key's slow copy, `KEY/slow`: the same messages, but few, for who would throw most of them away.

Waking up is most of what a message costs its sender, the bus and its receiver, and what a receiver does not want it has
been woken for all the same. A copy that nobody hears costs nothing.
"""

from swarm.bus_protocol import BusLike

SLOW = "slow"
"""The last chunk of a copy's key."""


APP_STATE_S = 0.5
"""s between two messages of an app's state: a display shows no more."""


class Slow:
    """The slow copy of one key."""

    def __init__(self, bus: BusLike, key: str, period: float) -> None:
        """`period`: s between two messages."""
        self._bus = bus
        self._key = f"{key}/{SLOW}"
        self._period = period
        self._due = float("-inf")

    def publish(self, message: object, t: float, *, news: bool = False, urgent: bool = False) -> None:
        """Take a message of time `t`, and publish it where one is due, or where it is `news`."""
        if t >= self._due:
            # From when it was due, not from now: a period need not be a multiple of the fast key's.
            self._due = max(self._due, t - self._period) + self._period
        elif not news:
            return
        self._bus.publish(self._key, message, urgent=urgent)
