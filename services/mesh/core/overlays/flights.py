"""What the unicast overlay keeps of own messages until their end, and what it tells of those that pass."""

from collections import deque
from typing import NamedTuple

_NEVER = float("inf")


class Hop(NamedTuple):
    """A message, or the answer to it, is handed to a neighbour."""

    sender: str
    """Of the message, also where it is the answer."""
    to: str
    number: int
    """Counts what this sender sent to this receiver, from 1."""
    next_hop: str
    """The neighbour."""
    back: bool
    """Whether it is the answer."""
    key: str = ""
    """Of the message. An answer has none: empty on its way, known where it begins."""
    token: object = None
    """Of an own message: what it was sent with."""


class Flight:
    """An own message until its end."""

    __slots__ = ("began", "deadline", "key", "next_at", "number", "payload", "priority", "to", "token", "tries", "via",
                 "wait")  # fmt: skip

    def __init__(
        self, token: object, to: str, key: str, payload: bytes, priority: int, now: float, deadline: float
    ) -> None:
        self.token = token
        self.to = to
        self.key = key
        self.payload = payload
        self.priority = priority
        self.began = now
        self.deadline = deadline
        self.number = 0
        self.tries = 0
        self.wait = 0.0
        self.next_at = _NEVER
        self.via: str | None = None
        """The neighbour it was handed to; None where there was no route."""


class Receiver:
    """Own messages to one robot."""

    __slots__ = ("flights", "next_number", "waiting")

    def __init__(self) -> None:
        self.next_number = 1
        self.flights: dict[int, Flight] = {}
        self.waiting: deque[Flight] = deque()
