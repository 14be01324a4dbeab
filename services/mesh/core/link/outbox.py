"""The queue of one connection: bounded classes of messages that wait to leave.

Messages wait here rather than in the kernel, where nothing could overtake them any more. Stops leave first, however
much is on its way, and no other message takes their room. Control leaves before sync. Sync leaves before bulk, but for
`WEIGHT` bytes of it bulk gets one where both wait, so that no class can silence another for ever. Bulk may be large: it
leaves in fragments, the keys taking turns, so that a small message need not wait for a large one of another key.

A full class of stops, control or sync loses its oldest message: in these streams the newest is worth most, and a lost
one is asked for again end to end. Bulk pushes back instead: a message that does not fit is refused, and who sent it is
told where that is possible. A part of bulk's room is kept for latest values, which a queue full of files must not shut
out.

Messages name their channels by keys. A key's text crosses a connection once, afterwards a handle of two bytes stands
for it (`Channels`).
"""

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

from services.mesh.core.link.flow import MAX_INCOMPLETE_BYTES, SYNC_EXTRA
from services.mesh.core.wire.frames import BULK, CONTROL, HALTS, MAX_CHANNELS, MAX_PAYLOAD, NEIGHBOURS, SYNC

SENT = ("sent_control", "sent_sync", "sent_bulk", "sent_control")
"""The counter of sent messages, by class."""

WIRE_CLASS = (CONTROL, SYNC, BULK, CONTROL)
"""The class of a message's frame."""


def name_of(overlay: int, key: str) -> str:
    """Return the name of a channel on our side: the key, with the overlay's digit before it unless it is
    `neighbours`. Keys begin with a letter."""
    return key if overlay == NEIGHBOURS else f"{overlay}{key}"


def overlay_of(name: str) -> tuple[int, str]:
    """Overlay and key of a channel."""
    return (int(name[0]), name[1:]) if name[0].isdigit() else (NEIGHBOURS, name)


class Channels:
    """Our handles for the keys we send on one connection; when all are taken, the least recently used one is bound
    anew. Until then nobody looks who was used when."""

    def __init__(self, size: int = MAX_CHANNELS) -> None:
        self._size = size
        self._handles: dict[str, int] = {}

    def handle(self, key: str) -> tuple[int, bool]:
        """Return the handle of `key`, and whether the other end must be told of it first."""
        handles = self._handles
        handle = handles.get(key)
        if handle is None:
            handle = len(handles) if len(handles) < self._size else handles.pop(next(iter(handles)))
            handles[key] = handle
            return handle, True
        if len(handles) == self._size:
            handles[key] = handles.pop(key)
        return handle, False


class Limit(NamedTuple):
    """Bounds of one class."""

    messages: int
    size: int
    """Bytes of keys and payloads."""


LIMITS = {
    CONTROL: Limit(64, 16 * 1024),
    SYNC: Limit(256, 64 * 1024),
    BULK: Limit(1024, MAX_INCOMPLETE_BYTES),
    HALTS: Limit(64, 64 * 1024),
}

FOR_LATEST = Limit(256, 256 * 1024)
"""What of bulk's room only latest values may use."""

WEIGHT = 8
"""Bytes of sync for each of bulk, where both wait."""

MAX_BEGUN = 16
"""Messages of which a part has left: the other end holds room for so many at least."""


@dataclass(slots=True, eq=False)
class QueuedMessage:
    """One message that waits; a newer value may replace its payload until a part of it has left."""

    priority: int
    key: str
    payload: bytes
    latest: bool
    sent: int = 0
    """Bytes of the payload that have left."""
    parts: int = 0
    """Fragments that have left."""

    @property
    def size(self) -> int:
        """Bytes it counts against its class."""
        return len(self.key) + len(self.payload)


class OutgoingPart(NamedTuple):
    """The next piece of a message that leaves in fragments."""

    message: QueuedMessage
    number: int
    data: bytes
    last: bool


class Outbox:
    """The queue of one connection."""

    def __init__(self, counters: Counter[str]) -> None:
        """Counts in `overflowed` what was dropped because its class was full, in `pushed_back` what was refused for
        that, in `replaced` what a newer value took the place of."""
        self._counters = counters
        # Lists: they are short, and an empty deque takes 0.7 kB of a robot that has three on each link.
        self._urgent: tuple[list[QueuedMessage], ...] = ([], [], [], [])
        """What waits of each class; bulk waits elsewhere."""
        self._bulk: dict[str, list[QueuedMessage]] = {}
        self._turns: list[str] = []
        self._sizes = [0, 0, 0, 0]
        self.waiting = 0
        """Messages that wait."""
        self._latest: dict[str, QueuedMessage] = {}
        self._begun = 0
        self._credit = 0.0
        self.dropped = 0
        """Messages overflowed or pushed back on this connection."""

    def __bool__(self) -> bool:
        return self.waiting > 0

    @property
    def waiting_bytes(self) -> int:
        """Bytes of keys and payloads that wait; a message counts whole until its last part has left."""
        return sum(self._sizes)

    def leaves(self, free: float) -> bool:
        """Return whether `pop` has something."""
        control, sync, _, halts = self._urgent
        return bool(halts or (free > -SYNC_EXTRA and (control or sync)) or (free > 0 and self._turns))

    @property
    def bulk_waits(self) -> bool:
        """Whether bulk is among what waits."""
        return bool(self._turns)

    def push(self, priority: int, key: str, payload: bytes, latest: bool) -> bool:
        """Add a message; with `latest` it takes the place of one of the same key that still waits. False = refused."""
        if latest and (waiting := self._latest.get(key)) is not None:
            growth = len(payload) - len(waiting.payload)
            if waiting.priority == BULK and growth > 0 and self._sizes[BULK] + growth > LIMITS[BULK].size:
                self._counters["pushed_back"] += 1
                self.dropped += 1
                return False
            self._sizes[waiting.priority] += growth
            waiting.payload = payload
            self._counters["replaced"] += 1
            if waiting.priority != BULK:
                self._shrink(waiting.priority)
            return True
        message = QueuedMessage(priority, key, payload, latest)
        if priority == BULK and not self._fits(message):
            self._counters["pushed_back"] += 1
            self.dropped += 1
            return False
        if latest:
            self._latest[key] = message
        if priority != BULK:
            self._urgent[priority].append(message)
        elif (queue := self._bulk.get(key)) is not None:
            queue.append(message)
        else:
            self._bulk[key] = [message]
            self._turns.append(key)
        self.waiting += 1
        self._sizes[priority] += len(key) + len(payload)
        if priority != BULK:
            self._shrink(priority)
        return True

    def pop(self, free: float = 1.0, fragment: int = MAX_PAYLOAD) -> QueuedMessage | OutgoingPart | None:
        """Take what leaves next: a whole message, or a part of at most `fragment` bytes."""
        control, urgent, _, halts = self._urgent
        if halts:
            return self._take(halts)
        if (control or urgent) and free <= -SYNC_EXTRA:
            return None
        if control:
            return self._take(control)
        if urgent:
            if not self._turns or self._credit < fragment:
                message = self._take(urgent)
                if self._turns:
                    self._credit += message.size / WEIGHT
                return message
            self._credit -= fragment
            return self._next_bulk(fragment)
        if free > 0 and self._turns:
            return self._next_bulk(fragment)
        return None

    def restart(self, part: OutgoingPart) -> None:
        """The other end cannot use this part: send its message from the beginning, or lose it where it was the last."""
        if part.last:
            self._counters["overflowed"] += 1
            self.dropped += 1
        else:
            part.message.sent = part.message.parts = 0
            self._begun -= 1

    def clear(self) -> None:
        """Forget all messages that wait."""
        for queue in self._urgent:
            queue.clear()
        self._bulk.clear()
        self._turns.clear()
        self._sizes = [0, 0, 0, 0]
        self.waiting = 0
        self._latest.clear()
        self._begun = 0

    def _fits(self, message: QueuedMessage) -> bool:
        messages, size = LIMITS[BULK]
        if not message.latest:
            messages, size = messages - FOR_LATEST.messages, size - FOR_LATEST.size
        waiting = self.waiting - sum(map(len, self._urgent))
        return waiting < messages and self._sizes[BULK] + message.size <= size

    def _next_bulk(self, fragment: int) -> QueuedMessage | OutgoingPart:
        """Return the next piece of bulk; its key goes to the end of the turns."""
        while True:
            key = self._turns[0]
            queue = self._bulk[key]
            message = queue[0]
            whole = not message.parts and len(message.payload) <= fragment
            if whole or message.parts or self._begun < MAX_BEGUN:
                break
            # One of those that have begun comes sooner or later, since they are fewer than the keys that wait.
            self._turns.append(self._turns.pop(0))
        if whole:
            self._leave(key, queue)
            return message
        if not message.parts:
            self._begun += 1
            if message.latest:
                del self._latest[key]
                message.latest = False
        number, start = message.parts, message.sent
        data = message.payload[start : start + fragment]
        message.parts += 1
        message.sent += len(data)
        last = message.sent == len(message.payload)
        if last:
            self._begun -= 1
            self._leave(key, queue)
        else:
            self._turns.append(self._turns.pop(0))
        return OutgoingPart(message, number, data, last)

    def _leave(self, key: str, queue: list[QueuedMessage]) -> None:
        """The first message of the key whose turn it is has left wholly."""
        self._take(queue)
        self._turns.pop(0)
        if queue:
            self._turns.append(key)
        else:
            del self._bulk[key]
            if not self._turns:
                self._credit = 0.0

    def _take(self, queue: list[QueuedMessage]) -> QueuedMessage:
        message = queue.pop(0)
        self.waiting -= 1
        self._sizes[message.priority] -= len(message.key) + len(message.payload)
        if message.latest:
            del self._latest[message.key]
        return message

    def _shrink(self, priority: int) -> None:
        queue, limit = self._urgent[priority], LIMITS[priority]
        while len(queue) > limit.messages or self._sizes[priority] > limit.size:
            self._take(queue)
            self._counters["overflowed"] += 1
            self.dropped += 1
