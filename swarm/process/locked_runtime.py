"""The runtime of a process on a robot: many threads, one lock.

Whoever calls a shell holds the lock: Zenoh's thread, the thread that reads sockets, that of the planned calls, or a
worker's thread at the end of a job. So a shell's call runs on whichever thread brought its cause, and no hand-over
between threads delays a message. Nothing waits under the lock.
"""

import heapq
import logging
import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from itertools import count
from typing import Any, TypeVar, cast

from swarm import clock
from swarm.bus.protocol import BusLike
from swarm.errors import SwarmError

F = TypeVar("F", bound=Callable[..., Any])

_Call = tuple[Callable[..., object], tuple[Any, ...]]

NEVER = float("inf")


class LockedRuntime:
    """See `swarm.process.runtime.Schedule` and `services.mesh.surroundings.Surroundings`. One thread makes the planned
    calls: it waits until `next_time`, then calls `call_due`."""

    def __init__(self, bus: BusLike, counters: Counter[str], log: logging.Logger) -> None:
        self.bus = bus
        self.counters = counters
        self.log = log
        self.next_time = NEVER
        """The time at which `call_due` has something to do."""
        self._lock = threading.RLock()
        self._depth = 0
        """The number of nested entries."""
        self._soon: deque[_Call] = deque()
        self._outside: list[_Call] = []
        self._times: list[tuple[float, int, _Call]] = []
        """A heap; the number decides where times are equal."""
        self._number = count()
        self._call_next = self.entry(self._on_next)

    @property
    def now(self) -> float:
        """The robot's clock, s."""
        return clock.now()

    def at(self, time: float, call: Callable[..., object], *arguments: Any) -> None:
        """Call at `time`, or at once where that is past."""
        with self._lock:
            heapq.heappush(self._times, (time, next(self._number), (call, arguments)))
            self.next_time = self._times[0][0]

    def soon(self, call: Callable[..., object], *arguments: Any) -> None:
        """Call at the end of the present entry, or of the next one."""
        self._soon.append((call, arguments))

    def outside(self, call: Callable[..., object], *arguments: Any) -> None:
        """Call after the present entry, by the thread that held the lock, so that the calls keep their order."""
        self._outside.append((call, arguments))

    def entry(self, call: F) -> F:
        """`call` with the lock around it."""

        def entered(*arguments: Any) -> Any:
            with self._lock:
                self._depth += 1
                try:
                    result = self._enter(call, arguments)
                finally:
                    self._depth -= 1
                outside: Sequence[_Call] = ()
                if self._outside and not self._depth:
                    outside, self._outside = self._outside, []
            for after, rest in outside:
                after(*rest)
            return result

        return cast(F, entered)

    def call_due(self) -> None:
        """Make the calls whose time has come. Only one thread may do so."""
        while self.next_time <= clock.now():
            self._call_next()

    def _enter(self, call: Callable[..., object], arguments: tuple[Any, ...]) -> Any:
        """Make a call, and what it wants to be made soon."""
        try:
            result = call(*arguments)
        except SwarmError:
            # It costs the sample that led to it. After anything else, a defect, nothing is done any more.
            self._do_what_is_soon()
            raise
        self._do_what_is_soon()
        return result

    def _do_what_is_soon(self) -> None:
        while self._soon and self._depth == 1:
            call, arguments = self._soon.popleft()
            call(*arguments)

    def _on_next(self) -> None:
        _, _, (call, arguments) = heapq.heappop(self._times)
        self.next_time = self._times[0][0] if self._times else NEVER
        call(*arguments)
