"""What waits to leave on one connection: three bounded classes, most urgent first.

Messages wait here rather than in the kernel, where nothing could overtake them any more. Where a class is
full its oldest message goes: in every stream we carry the newest one is worth most, and a lost one is asked
for again end to end.
"""

from collections import Counter, deque
from typing import NamedTuple

from services.mesh.core.frames import BULK, CONTROL, SYNC


class Limit(NamedTuple):
    """Bounds of one class."""

    messages: int
    size: int
    """Bytes of keys and payloads."""


LIMITS = {CONTROL: Limit(64, 16 * 1024), SYNC: Limit(256, 64 * 1024), BULK: Limit(1024, 64 * 1024)}


class Message:
    """One message that waits; a newer value may replace its payload."""

    __slots__ = ("key", "latest", "payload", "priority")

    def __init__(self, priority: int, key: str, payload: bytes, latest: bool) -> None:
        self.priority = priority
        self.key = key
        self.payload = payload
        self.latest = latest


class Outbox:
    """The queue of one connection."""

    def __init__(self, counters: Counter[str]) -> None:
        """Counts in `overflowed` what was dropped because its class was full, in `replaced` what a newer value was."""
        self._counters = counters
        self._queues: tuple[deque[Message], ...] = (deque(), deque(), deque())
        self._sizes = [0, 0, 0]
        self._latest: dict[str, Message] = {}

    def __bool__(self) -> bool:
        return any(self._queues)

    def push(self, priority: int, key: str, payload: bytes, latest: bool) -> None:
        """Add a message; with `latest` it takes the place of one of the same key that still waits."""
        if latest and (waiting := self._latest.get(key)) is not None:
            self._sizes[waiting.priority] += len(payload) - len(waiting.payload)
            waiting.payload = payload
            self._counters["replaced"] += 1
            self._shrink(waiting.priority)
            return
        message = Message(priority, key, payload, latest)
        if latest:
            self._latest[key] = message
        self._queues[priority].append(message)
        self._sizes[priority] += len(key) + len(payload)
        self._shrink(priority)

    def pop(self) -> Message | None:
        """The most urgent message, the oldest of its class; None when nothing waits."""
        for queue in self._queues:
            if queue:
                return self._take(queue)
        return None

    def clear(self) -> None:
        """Forget what waits."""
        for queue in self._queues:
            queue.clear()
        self._sizes = [0, 0, 0]
        self._latest.clear()

    def _take(self, queue: deque[Message]) -> Message:
        message = queue.popleft()
        self._sizes[message.priority] -= len(message.key) + len(message.payload)
        if message.latest:
            del self._latest[message.key]
        return message

    def _shrink(self, priority: int) -> None:
        queue, limit = self._queues[priority], LIMITS[priority]
        while len(queue) > limit.messages or self._sizes[priority] > limit.size:
            self._take(queue)
            self._counters["overflowed"] += 1
