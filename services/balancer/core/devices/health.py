"""The health of the board: battery, and the firmware's counters."""

from services.balancer.core.devices import balboa
from services.balancer.core.devices.battery import UNKNOWN_S
from services.balancer.core.slack.transfers import piece
from services.balancer.core.slack.wire_time import WHOLE, Room, Transfer
from swarm.messages import Battery

LOOK_S = 0.5
TELL_S = 1.0


class BoardHealth:
    """A slack task: reads the housekeeping twice a second."""

    def __init__(self, now: float) -> None:
        self.news: Battery | None = None
        """What is to be told; whoever takes it sets None."""
        self.found: balboa.Housekeeping | None = None
        """The last look."""
        self._found_at = now
        self.remarks: list[str] = []
        """What the firmware noticed; whoever takes them clears the list."""
        self._look_at = self._tell_at = now
        self._data = b""
        """What was read of it so far."""

    def overdue(self, now: float) -> bool:
        """Return whether the last look is too old to judge the battery by."""
        return now > self._found_at + UNKNOWN_S

    def next(self, now: float, room: Room = WHOLE) -> Transfer | None:
        if now < self._look_at:
            return None
        return piece(balboa.BUTTONS + len(self._data), balboa.BUTTONS + balboa.HOUSEKEEPING_SIZE, room)

    def take(self, data: bytes, now: float) -> None:
        self._data += data
        if len(self._data) < balboa.HOUSEKEEPING_SIZE:
            return
        data, self._data = self._data, b""
        found, before = balboa.decode_housekeeping(data), self.found
        self.found, self._found_at, self._look_at = found, now, now + LOOK_S
        if now >= self._tell_at:
            self._tell_at = max(self._tell_at + TELL_S, now)
            self.news = Battery(now, found.battery)
        if before is None:
            return
        if found.encoder_errors != before.encoder_errors:
            self.remarks.append(f"encoders: both channels changed at once, left and right {found.encoder_errors}")
        if found.bus_resets != before.bus_resets:
            self.remarks.append(
                f"the ATmega dropped a transfer that had stopped in the middle, {found.bus_resets} so far"
            )

    def fail(self, error: OSError, now: float) -> None:
        del error  # the control loop meets it too, and names it
        self._look_at, self._data = now + LOOK_S, b""
