"""The gyro's zero: what it shows while the robot rests, found as the mean of a second of samples."""

import math
from typing import NamedTuple

from services.balancer.core.imu import Reading

SETTLE_S = 1.0
"""The sensor's filters need this long after it was set up."""
STILL_SAMPLES = 100
STILL_RANGE = math.radians(3.0)
"""rad/s between the least and the largest sample of a robot at rest; noise makes about 0.4 degrees a second."""


class Zero(NamedTuple):
    """Of the three axes, rad/s."""

    pitch: float
    up: float = 0.0
    back: float = 0.0


class GyroZero:
    """Finds the zero: time for the filters to settle, then 100 samples at rest."""

    def __init__(self, settle_s: float = SETTLE_S) -> None:
        """A sensor that has been on for long needs no time to settle: 0."""
        self._settle_s = settle_s
        self._start: float | None = None
        self._samples: list[tuple[float, float, float]] = []
        self.restarts = 0
        """How often the robot was moved meanwhile."""

    def add(self, reading: Reading, now: float) -> Zero | None:
        """Take a sample; returns the zero once it is known."""
        if self._start is None:
            self._start = now
        if now - self._start < self._settle_s:
            return None
        self._samples.append((reading.pitch_rate, reading.up_rate, reading.back_rate))
        axes = tuple(zip(*self._samples, strict=True))
        if any(max(axis) - min(axis) > STILL_RANGE for axis in axes):
            self._samples.clear()
            self.restarts += 1
            return None
        if len(self._samples) < STILL_SAMPLES:
            return None
        return Zero(*(math.fsum(axis) / len(axis) for axis in axes))
