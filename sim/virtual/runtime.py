"""The runtime of one robot's services under virtual time: nothing runs at the same time as anything else, and a job
takes no time."""

import logging
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

from sim.virtual.bus import VirtualBus
from sim.virtual.events import Time
from sim.virtual.periodic_publisher import PeriodicPublisher
from swarm.errors import SwarmError

T = TypeVar("T")

_LOG = logging.getLogger("virtual")
"""A silent logger: what services log for people on a robot stands in the report of a virtual run."""
_LOG.addHandler(logging.NullHandler())
_LOG.propagate = False


class VirtualRuntime:
    """See `swarm.process.runtime.Runtime`. Each service of a robot has one of its own, as it has a process."""

    log = _LOG

    def __init__(self, robot: str, time: Time, bus: VirtualBus) -> None:
        self.robot = robot
        self.bus = bus
        self._time = time
        self.at = time.at
        self.soon = time.soon

    @property
    def now(self) -> float:
        return self._time.now

    @property
    def counters(self) -> Counter[str]:
        return self.bus.counters

    def every(self, period: float, call: Callable[[], None], keys: tuple[str, ...]) -> None:
        PeriodicPublisher(self._time, self.bus, keys, period, self._time.now + period, call)

    @staticmethod
    def entry(call: T) -> T:
        return call

    @staticmethod
    def outside(call: Callable[..., object], *arguments: Any) -> None:
        call(*arguments)

    @staticmethod
    def worker(name: str) -> "InlineWorker":
        return _WORKER

    def waits(self, reason: str) -> None:
        """See `Runtime`."""

    def ready(self) -> None:
        """See `Runtime`."""

    def degraded(self, reason: str) -> None:
        """See `Runtime`."""


class InlineWorker:
    """See `swarm.process.runtime.Worker`. A job that does not end is broken off by `sim.virtual.apps.hang`."""

    busy = False
    running_since = None
    thread = None

    @staticmethod
    def run(job: Callable[[], T], done: Callable[[T], None], failed: Callable[[SwarmError], None]) -> None:
        try:
            done(job())
        except SwarmError as error:
            failed(error)

    @staticmethod
    def close(within: float) -> bool:
        return True


_WORKER = InlineWorker()
