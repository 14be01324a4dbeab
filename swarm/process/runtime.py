"""The interface on which a shell runs: a clock, calls at a later time, and workers for long jobs.

A shell is the code around a core that does the core's input and output. It is written once, for one thread: at any
moment at most one of its calls runs. A robot gives it a `ThreadedRuntime` (`swarm.process.threads`), virtual time gives
it a runtime whose clock moves from one planned call to the next (`sim.virtual.runtime`).
"""

import logging
import math
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol, TypeVar

from swarm.bus.protocol import BusLike
from swarm.errors import SwarmError
from swarm.messages.codec import decoded

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])
M = TypeVar("M")


class Worker(Protocol):
    """Runs jobs that may take long, such as an author's step: one after the other, beside the shell's own calls."""

    @property
    def busy(self) -> bool:
        """Whether a job was given to it of which nobody has heard the end yet."""

    @property
    def running_since(self) -> float | None:
        """Return the time at which the running job began, s; None where none runs."""

    @property
    def thread(self) -> int | None:
        """The identity of the thread that runs the jobs, where it is one of its own."""

    def run(self, job: Callable[[], T], done: Callable[[T], None], failed: Callable[[SwarmError], None]) -> None:
        """Run `job()` when those before it have ended, then call the shell's `done(result)`. Where one of the two
        raises a `SwarmError`, call `failed(error)`."""

    def close(self, within: float) -> bool:
        """Run no further job. Wait at most `within` s for the one that runs; False where it has not ended."""


class Outlets(Protocol):
    """The outlets of every shell: its bus, counters and log."""

    @property
    def bus(self) -> BusLike:
        """Return the robot's bus."""

    @property
    def counters(self) -> Counter[str]:
        """Return the counters of what was dropped or refused, by name; they are part of the service's status."""

    @property
    def log(self) -> logging.Logger:
        """Return the log for the service's messages to people."""


class Process(Outlets, Protocol):
    """A service of a robot: `swarm.process.service.Service`, and every runtime."""

    @property
    def robot(self) -> str:
        """The name of the robot."""

    def waits(self, reason: str) -> None:
        """Tell what the service waits for until it is ready for the first time."""

    def ready(self) -> None:
        """Tell that the service does its work."""

    def degraded(self, reason: str) -> None:
        """Tell that the service cannot do all of its work, and why."""


class Schedule(Outlets, Protocol):
    """A clock, and calls that never run at the same time."""

    @property
    def now(self) -> float:
        """The robot's clock, s."""

    def at(self, time: float, call: Callable[..., object], *arguments: Any) -> None:
        """Call at `time`, or at once where that is past."""

    def soon(self, call: Callable[..., object], *arguments: Any) -> None:
        """Call after what runs now."""

    def entry(self, call: F) -> F:
        """`call` in a form that any thread may use: the bus, a timer, the app's own code. It waits until no other call
        of the shells runs."""


class Runtime(Process, Schedule, Protocol):
    """The surroundings of the shells of one process, or of one robot's services under virtual time. What its bus calls
    is an `entry`."""

    def every(self, period: float, call: Callable[[], None], keys: tuple[str, ...]) -> None:
        """Call every `period` s while somebody hears one of `keys`. While nobody does, call seldom, or not at
        all."""

    def worker(self, name: str) -> Worker:
        """Return a worker with a thread of that name."""


class Timer:
    """The next call of a core's timer: one at a time, for the earliest of the times that are asked for."""

    def __init__(self, at: Callable[[float, Callable[[float], None], float], None], call: Callable[[], None]) -> None:
        """`at` is that of a `Schedule`; `call()` may plan the next call."""
        self._at = at
        self._call = call
        self._planned = math.inf

    def plan(self, time: float | None) -> None:
        """Call at `time`, or earlier where a call is planned already; None plans nothing."""
        if time is not None and time < self._planned:
            self._planned = time
            self._at(time, self._due, time)

    def _due(self, time: float) -> None:
        if time == self._planned:  # else an earlier one came before
            self._planned = math.inf
            self._call()


def listen(outlets: Outlets, key: str, kind: type[M], take: Callable[[M], None]) -> None:
    """Let `take(message)` be called for each message of type `kind` under a key. What is none is counted and logged."""
    outlets.bus.subscribe(key, decoded(kind, take, partial(refuse, outlets)))


def refuse(outlets: Outlets, reason: object, counter: str = "refused_payloads") -> None:
    """Count and log a sample that is not what its key promises, or whose key is wrong (`refused_keys`)."""
    outlets.counters[counter] += 1
    outlets.log.debug("%s", reason)
