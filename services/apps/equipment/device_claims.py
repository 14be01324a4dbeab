"""The devices that an app has claimed of its robot, for as long as the app is well: LEDs, display and drive."""

import math
from collections.abc import Callable

from swarm.app.devices import Devices
from swarm.process.runtime import Runtime


class DeviceClaims:
    """Claims them again when that is due, and gives them back when the app is not well any more."""

    def __init__(self, runtime: Runtime, devices: Devices, well: Callable[[], bool]) -> None:
        """`well()`: an app that has stopped, failed or hangs is not."""
        self._runtime = runtime
        self._devices = devices
        self._well = well
        self._timer = math.inf
        devices.on_claim = runtime.entry(self.look)

    def look(self) -> None:
        """The app has taken something, or may be well or not well any more."""
        if not self._well():
            self._devices.release()
            return
        deadline = self._devices.next_deadline()
        if deadline is not None and deadline < self._timer:
            self._timer = deadline
            self._runtime.at(deadline, self._handle_timer, deadline)

    def close(self) -> None:
        self._devices.release()

    def _handle_timer(self, planned: float) -> None:
        if planned != self._timer:
            return  # an earlier one came before
        self._timer = math.inf
        if self._well():
            self._devices.handle_timer()
        self.look()
