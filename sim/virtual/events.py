"""The virtual clock and what is to happen: calls in the order of their times, and of their planning where those are
equal. That order is all there is of time, so equal seeds make equal runs."""

import heapq
import math
from collections import deque
from collections.abc import Callable
from typing import Any

_NEVER = float("inf")

_Call = tuple[Callable[..., object], tuple[Any, ...]]


class EventQueue:
    """Time passes only in `run`."""

    def __init__(self) -> None:
        self.now = 0.0
        """Seconds since the start of the run."""
        self.done = 0
        """Calls made so far."""
        self._stop = False
        # Large swarms do most things at once: a heap of times, each with its calls, is much smaller than one of calls.
        self._times: list[float] = []
        # A moment of its own has its one call there without a queue, which takes 0.7 kB.
        self._calls: dict[float, _Call | deque[_Call]] = {}
        self._present: deque[_Call] = deque()
        """The calls that are planned for this moment."""
        self._soon: deque[_Call] = deque()

    @property
    def true(self) -> float:
        """Return the world's time, whoever's clock this is."""
        return self.now

    def when(self, time: float) -> float:
        """Return the value of `now` in a call that was planned for `time`."""
        return time

    @property
    def next_time(self) -> float:
        """Return the time of the next call; infinity where none is planned."""
        if self._soon or self._present:
            return self.now
        return self._times[0] if self._times else _NEVER

    def at(self, time: float, call: Callable[..., object], *arguments: Any) -> None:
        """Call at `time`. Where that is past, call at once, but not before what is planned already."""
        if time <= self.now:
            self._present.append((call, arguments))
            return
        calls = self._calls.get(time)
        if calls is None:
            self._calls[time] = call, arguments
            heapq.heappush(self._times, time)
        elif isinstance(calls, deque):
            calls.append((call, arguments))
        else:
            self._calls[time] = deque((calls, (call, arguments)))

    def soon(self, call: Callable[..., object], *arguments: Any) -> None:
        """Call at this moment, after what runs now and before anything that was planned by `at`."""
        self._soon.append((call, arguments))

    def stop(self) -> None:
        """Let `run` return after the present call."""
        self._stop = True

    def run(self, until: float = _NEVER) -> bool:
        """Let time pass to `until`, or to the last planned call. Return False where `stop` ended it."""
        self._stop = False
        times, soon = self._times, self._soon
        done = 0
        try:
            while not self._stop:
                if soon:
                    call, arguments = soon.popleft()
                elif self._present:
                    call, arguments = self._present.popleft()
                elif times and times[0] <= until:
                    self.now = heapq.heappop(times)
                    calls = self._calls.pop(self.now)
                    if isinstance(calls, deque):
                        self._present = calls
                        continue
                    call, arguments = calls
                else:
                    if until != _NEVER:
                        self.now = max(self.now, until)
                    return True
                done += 1
                call(*arguments)
            return False
        finally:
            self.done += done


class LocalTime:
    """Time by a robot's own clock, with another zero and a rate that errs. Services on the robot know no other time."""

    def __init__(self, world: EventQueue, offset: float, rate: float) -> None:
        """The clock shows `offset` + (1 + `rate`) t at time t of the world, s; 1e-5 is 10 ppm too fast."""
        self._world = world
        self._offset, self._rate = offset, 1.0 + rate

    @property
    def now(self) -> float:
        """Return the time of the clock, s."""
        return self._offset + self._rate * self._world.now

    @property
    def true(self) -> float:
        return self._world.now

    @property
    def relation(self) -> dict[str, float]:
        """Return `offset` (s) and `rate`: the world's time is t + offset + rate t when this clock shows t."""
        return {"offset": -self._offset / self._rate, "rate": 1.0 / self._rate - 1.0}

    def when(self, time: float) -> float:
        return self._offset + self._rate * self._true(time)

    def at(self, time: float, call: Callable[..., object], *arguments: Any) -> None:
        """See `EventQueue`. The call never comes before this clock shows `time`: a caller that finds itself too early
        would plan the same time again, for ever."""
        self._world.at(self._true(time), call, *arguments)

    def soon(self, call: Callable[..., object], *arguments: Any) -> None:
        self._world.soon(call, *arguments)

    def _true(self, time: float) -> float:
        true = (time - self._offset) / self._rate
        while self._offset + self._rate * true < time:
            true = math.nextafter(true, math.inf)
        return true


Time = EventQueue | LocalTime
