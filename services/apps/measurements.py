"""Where an app's measurement of step k comes from: the live module's newest report, or row k of a recording.

Both come over the bus, and the app cannot tell them apart.
"""

import threading
from typing import Protocol

from swarm import clock
from swarm.errors import AppError, PayloadError
from swarm.messages import Measurement, Pose, Ranges
from swarm.messages.codec import decode
from swarm.messages.keys import key
from swarm.process.service import Service

ASK_AGAIN = 0.2
"""A row that did not come is asked for again after this, s: dwm or bus may be starting anew."""


class Measurements(Protocol):
    """A source of measurements."""

    def get(self, k: int) -> Measurement | None:
        """The measurement for step k; blocks until there is one. None when the service is to stop."""

    def close(self) -> None:
        """Let a blocked `get` return."""


def source_of(service: Service, last: int | None) -> Measurements:
    """The source that the config names for this robot; `last`: the last iteration, if there is one."""
    config = service.config
    if config.dwm.source.startswith("replay:"):
        return Replayed(service, last)
    if config.dwm.target is None:
        raise AppError(f"{config.path}: [dwm] target: expected the address of the target's module, this app needs it")
    return Live(service, config.dwm.target)


class Live:
    """The newest range to the target and the newest own place; a step waits only for the very first ones."""

    def __init__(self, service: Service, target: str) -> None:
        self._service = service
        self._target = target
        self._changed = threading.Condition()
        self._closed = False
        self._range: tuple[float, int, float] | None = None
        self._place: tuple[float, float] | None = None
        service.bus.subscribe(key(service.robot, "dwm", "ranges"), self._on_ranges)
        service.bus.subscribe(key(service.robot, "dwm", "pose"), self._on_pose)

    def get(self, k: int) -> Measurement | None:
        """See `Measurements`."""
        with self._changed:
            while self._range is None or self._place is None:
                if self._closed:
                    return None
                self._changed.wait()
            (t, sequence, distance), (x, y) = self._range, self._place
            return Measurement(t, sequence, distance, x, y)

    def close(self) -> None:
        """See `Measurements`."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _on_ranges(self, name: str, payload: bytes) -> None:
        try:
            message = decode(Ranges, payload, name)
        except PayloadError as error:
            self._refuse(error)
            return
        for item in message.ranges:
            if item.anchor == self._target and item.quality > 0:
                with self._changed:
                    self._range = (message.t - item.age, item.sequence, item.distance)
                    self._changed.notify_all()

    def _on_pose(self, name: str, payload: bytes) -> None:
        try:
            message = decode(Pose, payload, name)
        except PayloadError as error:
            self._refuse(error)
            return
        if message.quality > 0:
            with self._changed:
                self._place = (message.x, message.y)
                self._changed.notify_all()

    def _refuse(self, error: PayloadError) -> None:
        self._service.counters["refused_payloads"] += 1
        self._service.log.debug("%s", error)


class Replayed:
    """Row k by query; the next row is asked for at once, so that it is there when the step comes."""

    def __init__(self, service: Service, last: int | None) -> None:
        self._service = service
        self._last = last
        self._key = key(service.robot, "dwm", "measurement")
        self._changed = threading.Condition()
        self._closed = False
        self._rows: dict[int, Measurement] = {}
        self._asked = (-1, 0.0)

    def get(self, k: int) -> Measurement | None:
        """See `Measurements`."""
        while True:
            with self._changed:
                if k in self._rows:
                    row = self._rows[k]
                    self._rows = {later: kept for later, kept in self._rows.items() if later >= k}
                    break
            self._ask(k)
            with self._changed:
                if self._closed:
                    return None
                if k not in self._rows:
                    self._changed.wait(ASK_AGAIN)
        if self._last is None or k + 1 < self._last:
            self._ask(k + 1)
        return row

    def close(self) -> None:
        """See `Measurements`."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _ask(self, k: int) -> None:
        """Outside the lock: Zenoh may want its thread, which may be waiting for the lock in `_on_row`."""
        asked, at = self._asked
        now = clock.now()
        if asked != k or now - at >= ASK_AGAIN:
            self._asked = (k, now)
            self._service.bus.ask(self._key, self._on_row, timeout_s=1.0, sequence=k)

    def _on_row(self, name: str, payload: bytes) -> None:
        try:
            row = decode(Measurement, payload, name)
        except PayloadError as error:
            self._service.counters["refused_payloads"] += 1
            self._service.log.debug("%s", error)
            return
        with self._changed:
            self._rows.setdefault(row.sequence, row)
            self._changed.notify_all()
