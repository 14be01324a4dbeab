"""The virtual clock and what is to happen: calls in the order of their times, and of their planning where those are
equal. That order is all there is of time, so equal seeds make equal runs."""

import heapq
from collections import deque
from collections.abc import Callable
from typing import Any

_NEVER = float("inf")


class EventQueue:
    """Time passes only in `run`."""

    def __init__(self) -> None:
        self.now = 0.0
        """s since the start of the run."""
        self.done = 0
        """Calls made so far."""
        self._stop = False
        self._count = 0
        self._heap: list[tuple[float, int, Callable[..., object], tuple[Any, ...]]] = []
        self._soon: deque[tuple[Callable[..., object], tuple[Any, ...]]] = deque()

    def at(self, time: float, call: Callable[..., object], *arguments: Any) -> None:
        """Call at `time`; at once, but not before what is planned already, where it is past."""
        self._count += 1
        heapq.heappush(self._heap, (time if time > self.now else self.now, self._count, call, arguments))

    def soon(self, call: Callable[..., object], *arguments: Any) -> None:
        """Call at this moment, after what runs now and before anything that was planned by `at`."""
        self._soon.append((call, arguments))

    def stop(self) -> None:
        """Let `run` return after the present call."""
        self._stop = True

    def run(self, until: float = _NEVER) -> bool:
        """Let time pass to `until`, or to the last thing planned. False where `stop` ended it."""
        self._stop = False
        heap, soon, pop = self._heap, self._soon, heapq.heappop
        done = 0
        try:
            while not self._stop:
                if soon:
                    call, arguments = soon.popleft()
                elif heap and heap[0][0] <= until:
                    self.now, _, call, arguments = pop(heap)
                else:
                    if until != _NEVER:
                        self.now = max(self.now, until)
                    return True
                done += 1
                call(*arguments)
            return False
        finally:
            self.done += done
