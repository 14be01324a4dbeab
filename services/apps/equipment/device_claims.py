"""The devices that an app has claimed of its robot, for as long as the app is well: LEDs, display and drive."""

from collections.abc import Callable

from swarm.app.devices import Devices
from swarm.process.runtime import Runtime, Timer


class DeviceClaims:
    """Claims them again when that is due, and gives them back when the app is not well any more."""

    def __init__(
        self, runtime: Runtime, devices: Devices, well: Callable[[], bool], idle: Callable[[], bool] = lambda: False
    ) -> None:
        """`well()`: an app that has stopped, failed or hangs is not. `idle()`: whether the app makes no steps now; its
        robot stands still until it does."""
        self._devices = devices
        self._well = well
        self._idle = idle
        self._closed = False
        self._timer = Timer(runtime.at, self._handle_timer)
        devices.on_claim = runtime.entry(self.look)

    def look(self) -> None:
        """The app has taken something, or may be well or not well any more."""
        if self._closed or not self._well():
            self._devices.release()
            return
        self._timer.plan(self._devices.next_deadline())

    def close(self) -> None:
        """Give back everything for good, also what a step takes that has not ended yet."""
        self._closed = True
        self._devices.release()

    def _handle_timer(self) -> None:
        if not self._closed and self._well():
            self._devices.handle_timer(idle=self._idle())
        self.look()
