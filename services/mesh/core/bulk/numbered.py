"""Numbered messages between two robots: what a sender keeps of each until its end, and what a receiver has seen.

A sender counts what it sends to each robot from 1. What the receiver answers ends a message; until then the sender
keeps it, and repeats it as the overlay says. Small messages of unicast (`overlays.unicast`) and those that are offered
(`bulk.transfers`) are counted apart, by the same rules and with limits of their own.
"""

from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, TypeVar

INCARNATIONS = 4
"""Number of incarnations of one sender that are distinguished: copies of messages of an earlier one may still
arrive."""

_NEVER = float("inf")


class SeenNumbers:
    """Sequence numbers from 1 up, in any order, in constant memory: the highest, and one bit for each of those just
    below it. What is too old to tell counts as seen."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.highest = 0
        self._bits = 0

    def add(self, number: int) -> bool:
        """Note a number; whether it is new."""
        ahead = number - self.highest
        if ahead > 0:
            self._bits = (self._bits << ahead | 1) & (1 << self.size) - 1 if ahead < self.size else 1
            self.highest = number
            return True
        # A peer chooses the number. The size is checked before the shift, which could make an integer of 512 MiB.
        if -ahead >= self.size or self._bits >> -ahead & 1:
            return False
        self._bits |= 1 << -ahead
        return True

    def has(self, number: int) -> bool:
        """Return whether a number counts as seen."""
        behind = self.highest - number
        return behind >= self.size or (behind >= 0 and self._bits >> behind & 1 == 1)


class SeenLives:
    """The numbers seen of each sender, for each of its last incarnations."""

    def __init__(self, size: int) -> None:
        """`size` numbers of an incarnation are told apart."""
        self._size = size
        self._lives: dict[str, OrderedDict[int, SeenNumbers]] = {}

    def of(self, sender: str, incarnation: int) -> SeenNumbers:
        """Return the numbers seen of one incarnation."""
        lives = self._lives.setdefault(sender, OrderedDict())
        seen = lives.get(incarnation)
        if seen is None:
            seen = lives[incarnation] = SeenNumbers(self._size)
            if len(lives) > INCARNATIONS:
                lives.popitem(last=False)
        lives.move_to_end(incarnation)
        return seen


@dataclass(eq=False)
class Outgoing:
    """An own message until its end."""

    token: object
    to: str
    key: str
    payload: bytes
    deadline: float
    number: int = 0
    """0 while it waits for its turn."""
    wait: float = 0.0
    next_at: float = _NEVER
    """The time at which it is to be repeated."""


class Limits(NamedTuple):
    """Bounds of what a robot keeps."""

    messages: int
    size: int
    """Bytes of payloads."""
    under_way: int
    """Messages to one robot that are under way at the same time."""
    span: int
    """Numbers under way to one robot lie so close together: a receiver tells a limited number of them apart."""


M = TypeVar("M", bound=Outgoing)


@dataclass(eq=False)
class _Receiver(Generic[M]):
    next_number: int = 1
    under_way: dict[int, M] = field(default_factory=dict)
    waiting: deque[M] = field(default_factory=deque)


class Outbound(Generic[M]):
    """The own messages of one robot that have not ended."""

    def __init__(
        self, limits: Limits, launch: Callable[[M, float], None], ended: Callable[[object, str, str], None]
    ) -> None:
        """`launch(message, now)` sends a message whose turn has come; `ended(token, to, problem)` is called once for
        each, with an empty problem where it was delivered."""
        self._limits = limits
        self._launch = launch
        self._ended = ended
        self._receivers: dict[str, _Receiver[M]] = {}
        self.messages = 0
        self.size = 0
        """Bytes of payloads."""

    def has_room(self, size: int) -> bool:
        """Return whether one more message of so many bytes can be taken."""
        return self.messages < self._limits.messages and self.size + size <= self._limits.size

    def add(self, message: M, now: float) -> None:
        """Send a message when its turn comes."""
        self.messages += 1
        self.size += len(message.payload)
        receiver = self._receivers.setdefault(message.to, _Receiver())
        receiver.waiting.append(message)
        self._advance(receiver, now)

    def get(self, to: str, number: int) -> M | None:
        """Return a message that is under way."""
        receiver = self._receivers.get(to)
        return receiver.under_way.get(number) if receiver is not None else None

    def under_way(self) -> list[M]:
        """Messages that were sent."""
        return [message for receiver in self._receivers.values() for message in receiver.under_way.values()]

    def all(self) -> list[M]:
        """Messages to each robot that were sent, and those to it that wait for their turn."""
        return [
            message
            for receiver in self._receivers.values()
            for message in (*receiver.under_way.values(), *receiver.waiting)
        ]

    def next_deadline(self) -> float:
        """Return the time at which a message is to be repeated, or its time is over."""
        if not self.messages:
            return _NEVER
        return min((min(message.next_at, message.deadline) for message in self.all()), default=_NEVER)

    def give_up(self, to: str, key: str) -> None:
        """End the messages to `to` under this key: a newer value replaces them."""
        for message in self.all():
            if message.to == to and message.key == key:
                self.end(message, "replaced by a newer value", None)

    def end(self, message: M, problem: str, now: float | None) -> None:
        """End a message. With `now` those that wait advance."""
        receiver = self._receivers[message.to]
        if receiver.under_way.pop(message.number, None) is None:
            receiver.waiting.remove(message)
        self.messages -= 1
        self.size -= len(message.payload)
        if now is not None:
            self._advance(receiver, now)
        self._ended(message.token, message.to, problem)

    def _advance(self, receiver: _Receiver[M], now: float) -> None:
        while receiver.waiting and len(receiver.under_way) < self._limits.under_way:
            oldest = min(receiver.under_way, default=receiver.next_number)
            if receiver.next_number - oldest >= self._limits.span:
                return
            message = receiver.waiting.popleft()
            message.number = receiver.next_number
            receiver.next_number += 1
            receiver.under_way[message.number] = message
            self._launch(message, now)
