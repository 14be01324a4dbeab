"""Where an app's measurement of step k comes from under virtual time: the newest of the module, or row k of a
recording; as `services.apps.measurements`, but with a callback in place of waiting."""

from collections.abc import Callable

from services.dwm.replay import Row
from sim.virtual.bus import VirtualBus
from swarm.messages import Measurement, Pose, Ranges
from swarm.messages.codec import decode
from swarm.messages.keys import key
from swarm.recording.thesis_ranges import Recording

Ready = Callable[[Measurement], None]


class Live:
    """The newest range to the target and the newest own place; a step waits only for the very first ones."""

    def __init__(self, bus: VirtualBus, robot: str, target: str) -> None:
        self._target = target
        self._range: tuple[float, int, float] | None = None
        self._place: tuple[float, float] | None = None
        self._waiting: list[Ready] = []
        bus.subscribe(key(robot, "dwm", "ranges"), self._on_ranges)
        bus.subscribe(key(robot, "dwm", "pose"), self._on_pose)

    def get(self, k: int, ready: Ready) -> None:
        """See `sync.Measurements`."""
        self._waiting.append(ready)
        self._serve()

    def _serve(self) -> None:
        if self._range is None or self._place is None:
            return
        waiting, self._waiting = self._waiting, []
        (t, sequence, distance), (x, y) = self._range, self._place
        for ready in waiting:
            ready(Measurement(t, sequence, distance, x, y))

    def _on_ranges(self, name: str, payload: bytes) -> None:
        message = decode(Ranges, payload, name)
        for item in message.ranges:
            if item.anchor == self._target and item.quality > 0:
                self._range = (message.t - item.age, item.sequence, item.distance)
        self._serve()

    def _on_pose(self, name: str, payload: bytes) -> None:
        message = decode(Pose, payload, name)
        if message.quality > 0:
            self._place = (message.x, message.y)
        self._serve()


class Replayed:
    """Row k of a recording; past its end there is none, and the step waits for ever."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording

    def get(self, k: int, ready: Ready) -> None:
        """See `sync.Measurements`."""
        if k < self._recording.steps:
            ready(Row(self._recording, k).measurement())
