"""The gyro's zero, kept in the runtime directory for the balancer after this one: it need not look for it for 2 s.

A zero is as good as the last moment in which a loop worked with it: it is taken by who starts within seconds, and not
when it was measured long ago, since it moves with the sensor's temperature. A boot clears the directory.
"""

import logging
import math
from pathlib import Path

from services.balancer.core.control.estimation.gyro import Zero
from swarm.files import atomic_write
from swarm.process.paths import GYRO_ZERO, VOLATILE

USED_S = 10.0
"""The most seconds since a loop last used the zero: a restart takes 1 s."""
MEASURED_S = 3600.0
"""The most seconds since the zero was measured. It drifts by 0.05 degrees a second for each kelvin (LSM6DS33 datasheet,
table 3)."""
LARGEST = math.radians(30.0)
"""Largest zero that is accepted, rad/s: the datasheet's typical zero is up to 10 degrees a second."""
_LONGEST = 200
"""Characters of a file that are read at most: five numbers."""

_log = logging.getLogger("balancer")


class ZeroFile:
    """Keeps the gyro's zero for the process after this one."""

    def __init__(self, runtime: Path) -> None:
        self._path = runtime / GYRO_ZERO
        self._zero: Zero | None = None
        self._measured = 0.0
        self._failed = False

    def read(self, now: float) -> Zero | None:
        """Return the zero of the process before, where it still holds; None otherwise."""
        try:
            with self._path.open() as file:
                *axes, measured, used = map(float, file.read(_LONGEST).split())
            zero = Zero(*axes)
        except (OSError, ValueError, TypeError):
            return None
        if not (0.0 <= now - used <= USED_S and measured <= used and now - measured <= MEASURED_S):
            return None
        if len(axes) != len(zero) or not all(abs(axis) <= LARGEST for axis in zero):
            return None
        self._zero, self._measured = zero, measured
        return zero

    def keep(self, zero: Zero, now: float) -> None:
        """Say that `zero` is in use now. Where it cannot be kept the next process looks for it."""
        if zero != self._zero:
            self._zero, self._measured = zero, now
        try:
            text = " ".join(map(repr, (*zero, self._measured, now)))
            atomic_write(self._path, text.encode(), unsynced=VOLATILE)
        except OSError as error:
            if not self._failed:
                _log.warning("the gyro's zero cannot be kept for a restart: %s", error)
            self._failed = True
