"""Processes of measurements and tests, none of which outlives what it was started for, and the folder of robots."""

import os
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from swarm.errors import LocalError

PATIENCE_S = 30.0
"""What ends by SIGTERM has ended by then, on a busy machine, too."""

MEMORY, DISK, ROOM_B = "/dev/shm", "/tmp", 1 << 30  # noqa: S108

Start = Callable[..., "subprocess.Popen[Any]"]


def robots_folder() -> "tempfile.TemporaryDirectory[str]":
    """A folder in memory if there is room, as a robot's `/run/swarm` is, with a path short enough for Unix sockets.
    Where it is on a disk, a control loop that makes a file there waits for what other programs write."""
    return tempfile.TemporaryDirectory(prefix="sw", dir=MEMORY if _is_fit(MEMORY) else DISK)


def _is_fit(place: str) -> bool:
    """Whether a file system has room, and runs programs: containers often have little memory, and none to run from."""
    if not Path(place).is_dir():
        return False
    found = os.statvfs(place)
    return found.f_bavail * found.f_frsize > ROOM_B and not found.f_flag & os.ST_NOEXEC


@contextmanager
def running(
    command: Sequence[object], *, start: Start = subprocess.Popen, **options: Any
) -> "Iterator[subprocess.Popen[Any]]":
    """A process that is ended with the block, whatever ends that: first by SIGTERM, then by SIGKILL. Its streams are
    closed. One that were left behind would go on beside later tests, and the warning of it would fail one of them.

    `options` are those of `subprocess.Popen`; `start` takes its place.
    """
    with start([str(word) for word in command], **options) as process:
        try:
            yield process
        finally:
            end(process)


@contextmanager
def lasting(command: Sequence[object], **options: Any) -> "Iterator[subprocess.Popen[Any]]":
    """`running`, for a process that is there as long as the block. Raises `LocalError` where it has ended before: what
    was measured in the block had no such load."""
    with running(command, **options) as process:
        yield process
        if process.poll() is not None:
            raise LocalError(f"{' '.join(map(str, command))} ended by itself, with code {process.returncode}")


def end(process: "subprocess.Popen[Any]") -> None:
    """End a process, one that has been stopped, too."""
    process.terminate()
    process.send_signal(signal.SIGCONT)
    try:
        process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
