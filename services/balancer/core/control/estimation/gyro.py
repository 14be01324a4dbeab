"""The gyro's zero: what it shows while the robot rests, found as the mean of a second of samples.

A balancer that was restarted need not look for it: the zero of the process before it holds, unless the first samples
are at rest and say something else.
"""

import math
from typing import NamedTuple

from services.balancer.core.devices.imu import ImuReading

SETTLE_S = 1.0
"""The sensor's filters need this long after it was set up."""
STILL_SAMPLES = 100
STILL_RANGE = math.radians(3.0)
"""rad/s between the least and the largest sample of a robot at rest; noise makes about 0.4 degrees a second."""

KEPT_CHECK_S = 0.2
"""Seconds for which a kept zero is compared with samples. The filters of a sensor that was never off need no more."""
KEPT_TOLERANCE = math.radians(1.0)
"""rad/s by which the mean of these may be off: their noise makes 0.1 degrees a second, a degree more or less in the
zero makes two degrees of tilt."""


class Zero(NamedTuple):
    """The zero of the three axes, rad/s."""

    pitch: float
    up: float = 0.0
    back: float = 0.0


class GyroZero:
    """Finds the zero: time for the filters to settle, then 100 samples at rest."""

    def __init__(self, settle_s: float = SETTLE_S, kept: Zero | None = None) -> None:
        """Use `settle_s` = 0 for a sensor that has been on for long. `kept` is an earlier zero, used unless samples
        contradict it."""
        self._settle_s = settle_s
        self._kept = kept
        self._start: float | None = None
        self._samples: list[tuple[float, float, float]] = []
        self.restarts = 0
        """How often the robot was moved meanwhile."""

    def add(self, reading: ImuReading, now: float) -> Zero | None:
        """Take a sample; returns the zero once it is known."""
        if self._start is None:
            self._start = now
        if self._kept is not None:
            self._samples.append((reading.pitch_rate, reading.up_rate, reading.back_rate))
            if now - self._start < KEPT_CHECK_S:
                return None
            if self._is_still() and any(
                abs(mean - kept) > KEPT_TOLERANCE for mean, kept in zip(self._mean(), self._kept, strict=True)
            ):
                self._kept = None
                self._samples.clear()
            return self._kept
        if now - self._start < self._settle_s:
            return None
        self._samples.append((reading.pitch_rate, reading.up_rate, reading.back_rate))
        if not self._is_still():
            self._samples.clear()
            self.restarts += 1
            return None
        return self._mean() if len(self._samples) >= STILL_SAMPLES else None

    def _is_still(self) -> bool:
        return all(max(axis) - min(axis) <= STILL_RANGE for axis in zip(*self._samples, strict=True))

    def _mean(self) -> Zero:
        return Zero(*(math.fsum(axis) / len(axis) for axis in zip(*self._samples, strict=True)))
