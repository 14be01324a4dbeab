"""Locks of files between processes. The kernel drops a lock when its process ends, however it ends.

Systems without such locks (Windows) run virtual time and tools for recordings only, one process at a time: there every
lock is free.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

try:
    import fcntl
except ModuleNotFoundError:
    fcntl = None  # type: ignore[assignment]


def take_lock(descriptor: int, *, wait: bool = False) -> None:
    """Take the exclusive lock of an open file. `wait`: until it is free; else raises `BlockingIOError` where another
    process has it."""
    if fcntl is not None:
        fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextlib.contextmanager
def folder_lock(folder: Path, *, wait: bool = True) -> Iterator[None]:
    """Hold the lock of a folder, as soon as it is free; without `wait`, raises `BlockingIOError` where it is not.
    Raises `OSError` where the folder cannot be opened."""
    if fcntl is None:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        take_lock(descriptor, wait=wait)
        yield
    finally:
        os.close(descriptor)


def is_held(path: Path) -> bool:
    """Return whether another process has the exclusive lock of a file at this moment. Raises `OSError` where it cannot
    be looked at."""
    if fcntl is None:
        return False
    descriptor = os.open(path, os.O_RDONLY)
    try:
        # A shared lock, so that two who look at the same time do not take each other for the holder.
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False
