"""What an app has taken of its robot, for as long as it is well: LEDs, display and drive."""

from swarm.app.devices import Devices


class DeviceClaims:
    """Claims them again where that is due, and gives them back when the app is not well any more."""

    def __init__(self, devices: Devices | None) -> None:
        """None: an app without a robot of its own."""
        self._devices = devices
        self._well = True

    def look(self, *, well: bool) -> None:
        """To be called every 0.1 s or so. An app that has stopped, failed or hangs is not well."""
        if self._devices is None:
            return
        if well:
            self._devices.handle_timer()
        elif self._well:
            self._devices.release()
        self._well = well

    def close(self) -> None:
        """The app ends."""
        if self._devices is not None:
            self._devices.release()
