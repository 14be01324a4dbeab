"""The runtime of an app's process on a robot: besides its lock a thread for what is planned, and one for each worker.

An author's step runs on its worker's thread without the lock, since a blocked callback would hold up every key of the
process.
"""

import queue
import threading
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

from swarm import clock
from swarm.bus.protocol import BusLike, OnQuery, OnSample
from swarm.core.asynchronous import HANG
from swarm.errors import SwarmError
from swarm.process.locked_runtime import NEVER, LockedRuntime
from swarm.process.service import Service

T = TypeVar("T")

SELDOM = 0.5
"""Seconds between two calls of `every` while nobody hears what they publish."""
_FEED = 1.0
"""Seconds between two feedings of systemd's watchdog."""
_JOIN = 2.0
"""Seconds that the thread of the planned calls has to end."""


class ThreadedRuntime(LockedRuntime):
    """See `swarm.process.runtime.Runtime`."""

    def __init__(self, service: Service) -> None:
        super().__init__(_SerialBus(service.bus, self), service.counters, service.log)
        self.robot = service.robot
        self._service = service
        self._changed = threading.Condition(self._lock)
        self._workers: list[ThreadWorker] = []
        self._closing = False
        self.at(self.now + _FEED, self._feed_watchdog)
        self._thread = threading.Thread(target=self._run_planned, name="timers", daemon=True)
        self._thread.start()

    def at(self, time: float, call: Callable[..., object], *arguments: Any) -> None:
        with self._lock:
            before = self.next_time
            super().at(time, call, *arguments)
            if time < before:
                self._changed.notify()

    def every(self, period: float, call: Callable[[], None], keys: tuple[str, ...]) -> None:
        wanted = self._service.bus.wanted

        def beat() -> None:
            self.at(self.now + (period if any(map(wanted, keys)) else max(period, SELDOM)), beat)
            call()

        self.at(self.now + period, beat)

    def worker(self, name: str) -> "ThreadWorker":
        worker = ThreadWorker(self, name)
        self._workers.append(worker)
        return worker

    def waits(self, reason: str) -> None:
        self._service.waits(reason)

    def ready(self) -> None:
        self._service.ready()

    def degraded(self, reason: str) -> None:
        self._service.degraded(reason)

    def close(self) -> None:
        """Make no planned call any more."""
        with self._lock:
            self._closing = True
            self._changed.notify()
        self._thread.join(_JOIN)

    def _run_planned(self) -> None:
        while not self._closing:
            self.call_due()
            with self._lock:
                wait = self.next_time - clock.now()
                if wait > 0 and not self._closing:
                    self._changed.wait(None if wait == NEVER else wait)

    def _feed_watchdog(self) -> None:
        """Feed the watchdog if no job hangs. That this runs shows that the lock is free and the clock goes on."""
        self.at(self.now + _FEED, self._feed_watchdog)
        began = [worker.running_since for worker in self._workers]
        if all(since is None or self.now - since < HANG for since in began):
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
        return self._given > 0

    @property
    def thread(self) -> int | None:
        return self._thread.ident

    def run(self, job: Callable[[], T], done: Callable[[T], None], failed: Callable[[SwarmError], None]) -> None:
        self._given += 1
        self._jobs.put((job, done, failed))

    def close(self, within: float) -> bool:
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
    """Drop a result that nobody waits for."""
