"""Values that an app gives to `robot.record` go to the recording, and on the bus to those who watch the run."""

from collections.abc import Callable

from swarm.bus.protocol import BusLike
from swarm.messages import AppOutput
from swarm.messages.codec import Value
from swarm.messages.keys import key

PERIOD_S = 0.1
"""Least time between two messages of a name; values between them are in the recording only."""

MAX_NAMES = 64


class RecordedValues:
    """Takes values as `Robot.recording` does."""

    def __init__(
        self, bus: BusLike, robot: str, app: str, recording: Callable[[str, float, Value], None] | None
    ) -> None:
        """`recording`: takes all of them; None where nothing is recorded."""
        self._bus, self._robot, self._app, self._recording = bus, robot, app, recording
        self._due: dict[str, float] = {}

    def __call__(self, name: str, t: float, value: Value) -> None:
        """Record a value of time `t`, s, and publish it where one of its name is due."""
        if self._recording is not None:
            self._recording(name, t, value)
        due = self._due.get(name)
        if (due is None and len(self._due) >= MAX_NAMES) or (due is not None and t < due):
            return
        self._due[name] = t + PERIOD_S
        self._bus.publish(key(self._robot, f"app/{self._app}", "record", name), AppOutput(t, {"value": value}))
