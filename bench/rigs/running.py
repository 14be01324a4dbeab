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

MEMORY, DISK = "/dev/shm", "/tmp"  # noqa: S108
ROOM_B = 1 << 30
"""Bytes that must be free in memory; several tests run at once, and each robot reserves some megabytes."""

Start = Callable[..., "subprocess.Popen[Any]"]


def robots_folder(*, ignore_cleanup_errors: bool = False) -> "tempfile.TemporaryDirectory[str]":
    """A folder in memory if there is room, as a robot's `/run/swarm` is, with a path short enough for Unix sockets.
    Where it is on a disk, a control loop that makes a file there waits for what other programs write.

    `ignore_cleanup_errors`: for who ends while processes still write there.
    """
    place = MEMORY if _is_fit(MEMORY) else DISK
    return tempfile.TemporaryDirectory(prefix="sw", dir=place, ignore_cleanup_errors=ignore_cleanup_errors)


def _is_fit(place: str) -> bool:
    """Whether a folder is there, has room, and can hold programs that run. Containers often have little room in memory,
    and forbid programs there."""
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
