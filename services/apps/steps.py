"""Steps to be done, for a thread that takes neighbours' frames while there are none: they make the next step."""

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from swarm.bus.lane import Lane

T = TypeVar("T")


class Steps(Generic[T]):
    """A queue; any thread puts, one gets."""

    def __init__(self, lane: Lane, take: Callable[[bytes], None]) -> None:
        """`take` is given what comes by the lane, on the thread that waits in `get`."""
        self._lane = lane
        self._take = take
        self._waiting: deque[T] = deque()
        self._thread: int | None = None

    def put(self, step: T) -> None:
        """Behind all others."""
        self._waiting.append(step)
        if threading.get_ident() != self._thread:
            self._lane.wake()

    def get(self) -> T:
        """The oldest one; waits for it."""
        self._thread = threading.get_ident()
        while not self._waiting:
            if (data := self._lane.wait()) is not None:
                self._take(data)
        return self._waiting.popleft()
