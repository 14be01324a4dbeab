"""The mesh's surroundings in a process: many threads, one lock.

Who makes the node produce bytes sends them at once, whether it is the reading thread or Zenoh's callback: no hand-over
between threads delays a message. Nothing waits under the lock. What is to be published is published after the lock is
released, by the thread that held it, so each link's messages keep their order.
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

F = TypeVar("F", bound=Callable[..., Any])

_Call = tuple[Callable[..., object], tuple[Any, ...]]

_NEVER = float("inf")


class LockedRuntime:
    """See `services.mesh.surroundings.Surroundings`. Calls at a time are made by the thread of `services.mesh.sockets`,
    which asks `next_time` for them."""

    def __init__(self, bus: BusLike, counters: Counter[str], log: logging.Logger) -> None:
        self.bus = bus
        self.counters = counters
        self.log = log
        self.next_time = _NEVER
        """When `call_due` has something to do."""
        self._lock = threading.Lock()
        self._soon: deque[_Call] = deque()
        self._outside: list[_Call] = []
        self._times: list[tuple[float, int, _Call]] = []
        """A heap; the number decides where times are equal."""
        self._number = count()
        self.call_due: Callable[[], None] = self.entry(self._call_due)
        """Make the calls whose time has come."""

    @property
    def now(self) -> float:
        """The robot's clock, s."""
        return clock.now()

    def at(self, time: float, call: Callable[..., object], *arguments: Any) -> None:
        """Call at `time`. Only the reading thread may ask for that, and everybody before that thread starts."""
        heapq.heappush(self._times, (time, next(self._number), (call, arguments)))
        self.next_time = self._times[0][0]

    def soon(self, call: Callable[..., object], *arguments: Any) -> None:
        """Call at the end of the present entry, or of the next one."""
        self._soon.append((call, arguments))

    def outside(self, call: Callable[..., object], *arguments: Any) -> None:
        """Call after the present entry."""
        self._outside.append((call, arguments))

    def entry(self, call: F) -> F:
        """`call` with the lock around it."""

        def entered(*arguments: Any) -> Any:
            with self._lock:
                result = call(*arguments)
                while self._soon:
                    later, rest = self._soon.popleft()
                    later(*rest)
                outside: Sequence[_Call] = ()
                if self._outside:
                    outside, self._outside = self._outside, []
            for after, rest in outside:
                after(*rest)
            return result

        return cast(F, entered)

    def _call_due(self) -> None:
        while self._times and self._times[0][0] <= clock.now():
            _, _, (call, arguments) = heapq.heappop(self._times)
            call(*arguments)
        self.next_time = self._times[0][0] if self._times else _NEVER
