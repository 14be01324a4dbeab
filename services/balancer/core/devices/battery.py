"""Guard of the battery: six AA cells (NiMH), read once a second.

Motors pull the voltage down for moments, so the best reading of the last ten seconds counts: a dip is over by then, an
empty battery is not. Below the warning one is told; below the limit the robot lies down. It also lies down where the
voltage is not read any more: an empty battery would let it fall.
"""

from collections import deque

from services.balancer.core import faults
from services.balancer.core.faults import MotorFault

OK = "ok"
LOW = "low"
EMPTY = "empty"
UNKNOWN = "unknown"

WINDOW_S = 10.0
UNKNOWN_S = 60.0
"""Seconds after which a voltage counts as unknown. A battery loses about 0.01 V in that time, and transfers that are
lost by chance take much less."""
HYSTERESIS = 0.1
"""V above the threshold that a battery must show to be better again."""

CAPACITY_WH = 17.28
"""Six cells of 1.2 V and 2.4 Ah (thesis section 2.4.1)."""
USABLE = 0.87
"""The thesis' realistic 4.5 to 5 h of the 5.46 h that the capacity gives."""
FULL = 7.8
"""V: 1.3 a cell, fresh from the charger [estimate]."""
POWER_MOVING_W, POWER_RESTING_W = 3.16, 1.73
"""Thesis table 2.5: with motors, and without."""


class BatteryGuard:
    """Judges the battery by its voltage."""

    def __init__(self, warning: float, limit: float) -> None:
        """Set the thresholds in V."""
        self._warning, self.limit = warning, limit
        self._readings: deque[tuple[float, float]] = deque()
        self._since: float | None = None
        self.level = OK
        """ok, low, empty, or unknown: once read, and not any more."""

    @property
    def volts(self) -> float | None:
        """The best of the last ten seconds, V; None before the first reading."""
        return max((volts for _, volts in self._readings), default=None)

    @property
    def fault(self) -> MotorFault | None:
        """Why the robot lies down, and does not stand up; None where the battery allows it to stand."""
        if self.level == UNKNOWN:
            return MotorFault(faults.BUS, f"the battery's voltage was not read for {UNKNOWN_S:g} s")
        return MotorFault(faults.BATTERY, f"battery empty: {self.volts:.1f} V") if self.level == EMPTY else None

    def update(self, volts: float | None, now: float) -> bool:
        """Take a reading, None where the last one is too old; True where the level has changed by it."""
        before = self.level
        if volts is None:
            self._readings.clear()
            self.level = self.level if self._since is None else UNKNOWN
            return self.level != before
        if self._since is None or (self._readings and now < self._readings[-1][0]):
            self._since = now
            self._readings.clear()
        self._readings.append((now, volts))
        while self._readings[0][0] < now - WINDOW_S:
            self._readings.popleft()
        if now - self._since >= WINDOW_S:
            self.level = self._judge()
        return self.level != before

    def time_left(self, moving: bool) -> float | None:
        """s until the limit, roughly: charge linear in the voltage, power as the thesis measured it. None before the
        first reading, and where the limit is that of other cells, above a full battery's voltage."""
        if self.volts is None or self.limit >= FULL:
            return None
        share = min(1.0, max(0.0, (self.volts - self.limit) / (FULL - self.limit)))
        return share * USABLE * CAPACITY_WH / (POWER_MOVING_W if moving else POWER_RESTING_W) * 3600

    def _judge(self) -> str:
        volts = max(volts for _, volts in self._readings)
        margin = {OK: (0.0, 0.0), UNKNOWN: (0.0, 0.0), LOW: (HYSTERESIS, 0.0), EMPTY: (HYSTERESIS, HYSTERESIS)}[
            self.level
        ]
        if volts < self.limit + margin[1]:
            return EMPTY
        return LOW if volts < self._warning + margin[0] else OK
