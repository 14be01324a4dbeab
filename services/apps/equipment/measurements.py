"""The source of an app's measurement of step k: the live module's newest report, or row k of a recording.

Both come over the bus, and the app cannot tell them apart.
"""

from collections.abc import Callable
from functools import partial
from typing import Protocol

from swarm.config import Config
from swarm.errors import AppError, SwarmError
from swarm.messages import Measurement, Pose, Ranges
from swarm.messages.codec import decode
from swarm.messages.keys import key
from swarm.process.runtime import Runtime, listen

ASK_AGAIN = 0.2
"""A row that did not come is asked for again after this, s: dwm or bus may be starting anew."""

Ready = Callable[[Measurement], None]


class Measurements(Protocol):
    """A source of measurements."""

    def get(self, k: int, ready: Ready) -> None:
        """Call `ready(measurement)` when that of step k is there."""


def source_of(runtime: Runtime, config: Config, last: int | None) -> Measurements:
    """Return the source that the config names for this robot; `last`: the last iteration, if there is one."""
    if config.dwm.source.startswith("replay:"):
        return Replayed(runtime, last)
    if config.dwm.target is None:
        raise AppError(f"{config.path}: [dwm] target: expected the address of the target's module, this app needs it")
    return Live(runtime, config.dwm.target)


class Live:
    """The newest range to the target and the newest own place; a step waits only for the very first ones."""

    def __init__(self, runtime: Runtime, target: str) -> None:
        self._target = target
        self._range: tuple[float, int, float] | None = None
        self._place: tuple[float, float] | None = None
        self._waiting: list[Ready] = []
        listen(runtime, key(runtime.robot, "dwm", "ranges"), Ranges, self._on_ranges)
        listen(runtime, key(runtime.robot, "dwm", "pose"), Pose, self._on_pose)

    def get(self, k: int, ready: Ready) -> None:
        self._waiting.append(ready)
        self._serve()

    def _serve(self) -> None:
        if self._range is None or self._place is None:
            return
        waiting, self._waiting = self._waiting, []
        (t, sequence, distance), (x, y) = self._range, self._place
        for ready in waiting:
            ready(Measurement(t, sequence, distance, x, y))

    def _on_ranges(self, message: Ranges) -> None:
        for item in message.ranges:
            if item.anchor == self._target and item.quality > 0:
                self._range = (message.t - item.age, item.sequence, item.distance)
        self._serve()

    def _on_pose(self, message: Pose) -> None:
        if message.quality > 0:
            self._place = (message.x, message.y)
        self._serve()


class Replayed:
    """Row k by query; the next row is asked for at once, so that it is there when the step comes."""

    def __init__(self, runtime: Runtime, last: int | None) -> None:
        self._runtime = runtime
        self._last = last
        self._key = key(runtime.robot, "dwm", "measurement")
        # A query waits for a lock that Zenoh's thread holds while it brings an answer.
        self._worker = runtime.worker("rows")
        self._rows: dict[int, Measurement] = {}
        self._wanted: tuple[int, Ready] | None = None
        self._asked = (-1, 0.0)

    def get(self, k: int, ready: Ready) -> None:
        self._wanted = k, ready
        self._serve()

    def _serve(self) -> None:
        if self._wanted is None:
            return
        k, ready = self._wanted
        row = self._rows.get(k)
        if row is None:
            self._ask(k)
            return
        self._wanted = None
        self._rows = {later: kept for later, kept in self._rows.items() if later >= k}
        if self._last is None or k + 1 < self._last:
            self._ask(k + 1)
        ready(row)

    def _ask(self, k: int) -> None:
        asked, at = self._asked
        now = self._runtime.now
        if asked != k or now - at >= ASK_AGAIN:
            self._asked = (k, now)
            ask = partial(self._runtime.bus.ask, self._key, self._on_row, timeout_s=1.0, sequence=k)
            self._worker.run(ask, _done, _failed)
            self._runtime.at(now + ASK_AGAIN, self._serve)

    def _on_row(self, name: str, payload: bytes) -> None:
        row = decode(Measurement, payload, name)
        if row.sequence not in self._rows:
            self._rows[row.sequence] = row
            self._serve()


def _done(_: object) -> None:
    """The answer comes by itself."""


def _failed(error: SwarmError) -> None:
    raise error
