"""The runtime of a process on a robot: one lock, one thread for what is planned, and a thread for each worker.

Whoever calls a shell holds the lock: Zenoh's thread, the thread of the planned calls, or a worker's thread at the end
of a job. So a shell's call runs on whichever thread brought its cause, and no hand-over between threads delays a
message. An author's step runs on its worker's thread without the lock, since a blocked callback would hold up every key
of the process.
"""

import heapq
import itertools
import logging
import queue
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable
from typing import Any, TypeVar, cast

from swarm import clock
from swarm.bus.protocol import BusLike, OnQuery, OnSample
from swarm.errors import SwarmError
from swarm.process.service import Service

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])

SELDOM = 0.5
"""s between two calls of `every` while nobody hears what they publish."""
STUCK = 10.0
"""s after which a job that still runs no longer feeds systemd's watchdog."""
_FEED = 1.0
"""s between two feedings of systemd's watchdog."""
_JOIN = 2.0
"""s that the thread of the planned calls has to end."""


class ThreadedRuntime:
    """See `swarm.process.runtime.Runtime`."""

    def __init__(self, service: Service) -> None:
        self.robot = service.robot
        self.log: logging.Logger = service.log
        self.counters: Counter[str] = service.counters
        self.bus: BusLike = _SerialBus(service.bus, self)
        self._service = service
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._depth = 0
        """How many calls of the shells are inside each other."""
        self._soon: deque[tuple[Callable[..., object], tuple[Any, ...]]] = deque()
        self._planned: list[tuple[float, int, Callable[..., object], tuple[Any, ...]]] = []
        self._numbers = itertools.count()
        self._workers: list[ThreadWorker] = []
        self._closing = False
        self._thread = threading.Thread(target=self._run_planned, name="timers", daemon=True)
        self._thread.start()
        self.at(self.now + _FEED, self._feed_watchdog)

    @property
    def now(self) -> float:
        """See `Runtime`."""
        return clock.now()

    def at(self, time: float, call: Callable[..., object], *arguments: Any) -> None:
        """See `Runtime`."""
        with self._lock:
            first = self._planned[0][0] if self._planned else float("inf")
            heapq.heappush(self._planned, (time, next(self._numbers), call, arguments))
            if time < first:
                self._changed.notify()

    def soon(self, call: Callable[..., object], *arguments: Any) -> None:
        """See `Runtime`."""
        with self._lock:
            if self._depth:
                self._soon.append((call, arguments))
            else:
                self._call(call, arguments)

    def every(self, period: float, call: Callable[[], None], keys: tuple[str, ...]) -> None:
        """See `Runtime`."""
        wanted = self._service.bus.wanted

        def beat() -> None:
            self.at(self.now + (period if any(map(wanted, keys)) else max(period, SELDOM)), beat)
            call()

        self.at(self.now + period, beat)

    def entry(self, call: F) -> F:
        """See `Runtime`."""

        def enter(*arguments: Any) -> Any:
            with self._lock:
                return self._call(call, arguments)

        return cast(F, enter)

    def worker(self, name: str) -> "ThreadWorker":
        """See `Runtime`."""
        worker = ThreadWorker(self, name)
        self._workers.append(worker)
        return worker

    def ready(self) -> None:
        """See `Runtime`."""
        self._service.ready()

    def degraded(self, reason: str) -> None:
        """See `Runtime`."""
        self._service.degraded(reason)

    def close(self) -> None:
        """Make no planned call any more."""
        with self._lock:
            self._closing = True
            self._changed.notify()
        self._thread.join(_JOIN)

    def _call(self, call: Callable[..., object], arguments: tuple[Any, ...]) -> Any:
        """Make a call, and what it wants to be made soon; the lock is held."""
        self._depth += 1
        try:
            try:
                result = call(*arguments)
            except SwarmError:
                # It costs the sample that led to it. After anything else, a defect, nothing is done any more.
                self._do_what_is_soon()
                raise
            self._do_what_is_soon()
            return result
        finally:
            self._depth -= 1

    def _do_what_is_soon(self) -> None:
        while self._soon and self._depth == 1:
            call, arguments = self._soon.popleft()
            call(*arguments)

    def _run_planned(self) -> None:
        with self._lock:
            while not self._closing:
                now = clock.now()
                if self._planned and self._planned[0][0] <= now:
                    _, _, call, arguments = heapq.heappop(self._planned)
                    self._call(call, arguments)
                else:
                    self._changed.wait(self._planned[0][0] - now if self._planned else None)

    def _feed_watchdog(self) -> None:
        """Only where the lock is free, the clock goes on and no job hangs is this process alive."""
        self.at(self.now + _FEED, self._feed_watchdog)
        began = [worker.running_since for worker in self._workers]
        if all(since is None or self.now - since < STUCK for since in began):
            self._service.watchdog()


class ThreadWorker:
    """See `swarm.process.runtime.Worker`."""

    def __init__(self, runtime: ThreadedRuntime, name: str) -> None:
        self.running_since: float | None = None
        self._runtime = runtime
        self._jobs: queue.SimpleQueue[tuple[Callable[[], Any], Callable[[Any], None], Callable[[SwarmError], None]]]
        self._jobs = queue.SimpleQueue()
        self._given = 0
        self._closing = False
        # A daemon: a job that never ends must not keep the process from ending.
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """See `Worker`."""
        return self._given > 0

    @property
    def thread(self) -> int | None:
        """See `Worker`."""
        return self._thread.ident

    def run(self, job: Callable[[], T], done: Callable[[T], None], failed: Callable[[SwarmError], None]) -> None:
        """See `Worker`."""
        self._given += 1
        self._jobs.put((job, done, failed))

    def close(self, within: float) -> bool:
        """See `Worker`."""
        self._closing = True
        self._jobs.put((_nothing, _ignore, _ignore))
        self._thread.join(within)
        return not self._thread.is_alive()

    def _work(self) -> None:
        while not self._closing:
            job, done, failed = self._jobs.get()
            if self._closing:
                return
            self.running_since = clock.now()
            result: Any = None
            problem: SwarmError | None = None
            try:
                result = job()
            except SwarmError as error:
                problem = error
            self._runtime.entry(self._ended)(result, problem, done, failed)

    def _ended(
        self,
        result: Any,
        problem: SwarmError | None,
        done: Callable[[Any], None],
        failed: Callable[[SwarmError], None],
    ) -> None:
        self.running_since = None
        self._given -= 1
        if self._closing:
            return
        if problem is None:
            try:
                done(result)
            except SwarmError as error:
                problem = error
        if problem is not None:
            failed(problem)


class _SerialBus:
    """A bus whose callbacks are entries of the shells."""

    def __init__(self, bus: BusLike, runtime: ThreadedRuntime) -> None:
        self._bus = bus
        self._entry = runtime.entry
        self.publish = bus.publish
        self.wanted = bus.wanted
        self.announce = bus.announce

    @property
    def connected(self) -> bool:
        return self._bus.connected

    def on_change(self, callback: Callable[[bool], None]) -> None:
        self._bus.on_change(self._entry(callback))

    def subscribe(self, keys: str | Iterable[str], callback: OnSample) -> object:
        return self._bus.subscribe(keys, self._entry(callback))

    def serve(self, key: str, answer: OnQuery) -> None:
        self._bus.serve(key, self._entry(answer))

    def ask(self, key: str, on_reply: OnSample, *, timeout_s: float = 1.0, **parameters: object) -> None:
        self._bus.ask(key, self._entry(on_reply), timeout_s=timeout_s, **parameters)

    def watch(self, key: str, callback: Callable[[str, bool], None]) -> None:
        self._bus.watch(key, self._entry(callback))


def _nothing() -> None:
    """The job that lets a worker see that it is to end."""


def _ignore(_: object) -> None:
    """Nobody waits for that one."""
