"""Whether a process holds the lock of a file, which says that it lives: the lock ends with it, however it ends."""

import fcntl
import os
from pathlib import Path


def is_held(path: Path) -> bool:
    """Whether somebody has an exclusive lock on it at this moment. Raises `OSError` where it cannot be looked at."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        # A shared lock, so that two who look at the same time do not take each other for the holder.
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False
