"""The virtual time of tests in which cores are joined in memory: calls in the order of their times, and of their
planning where those are equal; and deadlines that cores are asked for."""

import heapq
import itertools
from collections.abc import Callable, Iterable

NEVER = float("inf")
Timer = tuple[float, Callable[[], object]]


class TimedWorld:
    """Time passes only in `run`."""

    def __init__(self) -> None:
        self.now = 0.0
        """s since the start."""
        self._planned: list[tuple[float, int, Callable[[], object]]] = []
        self._number = itertools.count()

    def at(self, time: float, call: Callable[[], object]) -> None:
        """Call at `time`, at once where that is past."""
        heapq.heappush(self._planned, (time, next(self._number), call))

    def timers(self) -> Iterable[Timer]:
        """When cores want their timers handled, and what does so; asked after each call."""
        return ()

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let time pass, or less where `until` comes true; returns whether it did."""
        end = self.now + seconds
        while not until():
            deadline, handle = min(self.timers(), key=lambda timer: timer[0], default=(NEVER, None))
            planned = self._planned[0][0] if self._planned else NEVER
            if min(deadline, planned) > end:
                self.now = end
                return until()
            self.now = max(self.now, min(deadline, planned))
            if planned <= deadline or handle is None:
                handle = heapq.heappop(self._planned)[2]
            handle()
        return True
