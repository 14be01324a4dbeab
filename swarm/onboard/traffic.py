"""The number of messages of other robots' apps that come to a robot.

A swarm at full rate brings hundreds a second, too many to be seen one by one, and to hear them costs the robot's bus
more than all else that is watched. So one listens, and where they are too many rests, and tries again for a moment.
"""

import threading
from collections.abc import Callable

from swarm.bus.zenoh_bus import Bus, Subscription
from swarm.messages.keys import owner_of

FRAMES = ("swarm/*/app/*/sync/*", "swarm/*/app/*/sync/*/*", "swarm/*/app/*/latest/*")
"""Messages of synchronous and of asynchronous apps over the links between robots; what goes around one has a longer
key."""

MANY = 10.0
"""Messages a second from each robot above which nobody listens: the page does not show them either."""
LISTEN_S = 0.5
"""Seconds after which one decides whether they are too many."""
REST_S = 5.0
MAX_SENDERS = 4096


class Traffic:
    """The traffic on one bus. The caller runs `look` several times a second."""

    def __init__(self, bus: Bus, robot: str, passed: Callable[[str, int], None]) -> None:
        """`passed(sender, count)`: so many messages of that robot so far; called in a thread of the bus, and not while
        they are many. The messages of `robot` itself are left out."""
        self._bus = bus
        self._robot = robot
        self._passed = passed
        self._lock = threading.Lock()
        self._counts: dict[str, int] = {}
        self._heard = 0
        """Messages heard since the last decision. Only their number is kept: a slow reader may hold up the next one."""
        self._senders: set[str] = set()
        """The robots that sent these messages."""
        self._calm = False
        """Whether they were few the last time; until that is known nothing is told."""
        self._since = self._until = -REST_S
        self._subscription: Subscription | None = None

    def look(self, now: float) -> None:
        """Listen on, rest or begin again."""
        if now < self._until:
            return
        with self._lock:
            few = self._heard <= MANY * len(self._senders) * (now - self._since)
            self._calm = self._subscription is not None and few
            self._heard, self._senders = 0, set()
        self._since, self._until = now, now + LISTEN_S
        if self._subscription is None:
            self._subscription = self._bus.subscribe(FRAMES, self._take)
        elif not self._calm:
            self._subscription.close()
            self._subscription = None
            self._until = now + REST_S

    def _take(self, name: str, _: bytes) -> None:
        sender = owner_of(name)
        if sender is None:
            return
        with self._lock:
            self._heard += 1
            if len(self._senders) < MAX_SENDERS:
                self._senders.add(sender)
            if sender == self._robot or (sender not in self._counts and len(self._counts) >= MAX_SENDERS):
                return
            self._counts[sender] = count = self._counts.get(sender, 0) + 1
            calm = self._calm
        if calm:
            self._passed(sender, count)
