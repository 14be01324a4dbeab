"""A fast key's copies, for who would throw most of its messages away (`KEY/slow`), or looks at them later only
(`KEY/gathered`).

Waking up is most of what a message costs its sender, the bus and its receiver. A copy that nobody hears costs nothing.
"""

from swarm.bus.protocol import BusLike
from swarm.errors import LocalError
from swarm.messages import Gathered
from swarm.messages.codec import encode

SLOW, GATHERED = "slow", "gathered"
"""The last chunk of a copy's key."""

APP_STATE_S = 0.5
"""s between two messages of an app's state: a display shows no more."""

GATHERED_S = 0.4
"""s whose messages come together. The last ones of a key that falls silent come late, with the next one."""

GATHERED_BYTES = 32 * 1024
"""Packed messages that come together at most, in bytes: a replay on a fast computer has more than the bus takes in
`GATHERED_S`."""

_BIN_HEAD = 5
"""Bytes that msgpack puts before each of them at most."""


class Slow:
    """The slow copy of one key: the same messages, but few."""

    def __init__(self, bus: BusLike, key: str, period: float) -> None:
        """`period`: s between two messages."""
        self._bus = bus
        self._key = f"{key}/{SLOW}"
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


class Gathering:
    """The gathered copy of one key: the messages of `GATHERED_S` in one, or of less time where they are large."""

    def __init__(self, bus: BusLike, key: str) -> None:
        self._bus = bus
        self._key = f"{key}/{GATHERED}"
        self._waiting: list[bytes] = []
        self._size = 0
        self._due = float("-inf")

    def add(self, message: object, t: float) -> None:
        """Take a message of time `t`, and publish all that wait where that is due."""
        if not self._bus.wanted(self._key):
            self._clear()
            return
        try:
            packed = encode(message)
        except LocalError:
            return  # the bus drops, counts and logs the message itself
        size = len(packed) + _BIN_HEAD
        if self._size + size > GATHERED_BYTES:
            self.flush()
        self._waiting.append(packed)
        self._size += size
        if t >= self._due:
            self._due = t + GATHERED_S
            self.flush()

    def flush(self) -> None:
        """Publish what waits."""
        if self._waiting:
            self._bus.publish(self._key, Gathered(tuple(self._waiting)))
            self._clear()

    def _clear(self) -> None:
        self._waiting.clear()
        self._size = 0
