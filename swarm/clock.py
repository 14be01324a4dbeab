"""The clocks of a robot. Cores get `now` as an argument; only shells read it here."""

import time

now = time.monotonic
"""Seconds of the robot's monotonic clock: common to all its processes, never set back; for all deadlines."""

wall = time.time
"""Seconds since 1970, for file names and recordings only: it jumps when somebody sets it."""


def elapsed() -> float:
    """Return seconds of a clock that goes on while the machine sleeps, which its monotonic clock does not on Linux."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))
