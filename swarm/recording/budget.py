"""The limit of a robot's recordings on its disk: beyond it the oldest finished runs are deleted.

A run that is being recorded is never touched: its process holds a lock on its file (`RecordingFile`), and one that was
written to within the last minutes may be that of a process that is being started again.
"""

import contextlib
import logging
import os
from collections.abc import Callable
from pathlib import Path

from swarm.frozen import frozen
from swarm.process.locks import is_held, take_lock
from swarm.recording.reader import SUFFIX

RESTING_S = 120.0
"""Seconds without a change after which a run that no process holds is over: a service that is killed is started
again sooner."""

_BLOCK = 512
"""Bytes of `st_blocks` (stat(2))."""

_log = logging.getLogger("record")


@frozen
class _RunFolder:
    """One run's folder."""

    path: Path
    size: int
    """Bytes on the disk."""
    changed: float
    """The time at which something in it was written last, s since 1970."""
    held: bool
    """Whether a process records into it."""


def runs_of(root: Path) -> list[_RunFolder]:
    """Return the runs in a folder, the one that has rested longest first. What vanishes meanwhile is left out."""
    found = []
    with contextlib.suppress(OSError):
        for entry in sorted(os.scandir(root), key=lambda entry: entry.name):
            with contextlib.suppress(OSError):
                if entry.is_dir(follow_symlinks=False):
                    found.append(_look(Path(entry.path)))
    return sorted(found, key=lambda run: (run.changed, run.path.name))


class Budget:
    """Keeps the runs in one folder within their budget."""

    def __init__(self, root: Path, limit: float, now: Callable[[], float]) -> None:
        """`limit`: bytes; `now`: the time of day, s since 1970."""
        self._root = root
        self._limit = limit
        self._now = now
        self._told = False

    def keep(self) -> list[_RunFolder]:
        """Delete what is too much, as far as it may be: the runs that went. Each is logged; so is, once, that those
        that go on take more than the budget by themselves."""
        runs = runs_of(self._root)
        used = sum(run.size for run in runs)
        gone = []
        for run in runs:
            if used <= self._limit:
                break
            if run.held or 0 <= self._now() - run.changed < RESTING_S:
                continue
            try:
                _delete(run.path)
            except OSError as error:
                _log.warning("%s cannot be deleted: %s", run.path, error.strerror)
                continue
            used -= run.size
            gone.append(run)
            _log.warning(
                "%s is deleted, %s: recordings may take %s (recordings.budget)",
                run.path.name,
                shown(run.size),
                shown(self._limit),
            )
        if used > self._limit and not self._told:
            self._told = True
            _log.warning(
                "recordings take %s of %s (recordings.budget), and none of them is over",
                shown(used),
                shown(self._limit),
            )
        return gone


def shown(size: float) -> str:
    """Return a number of bytes as text for people."""
    return f"{size / 1e9:.2f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


def hold(file: int) -> None:
    """Let others see that a process records into this file, until it is closed or the process ends."""
    with contextlib.suppress(OSError):  # a file system without locks
        take_lock(file)


def _look(folder: Path) -> _RunFolder:
    about = folder.stat()
    size, changed, held = 0, about.st_mtime, False
    for path in folder.rglob("*"):
        with contextlib.suppress(FileNotFoundError):
            about = path.stat(follow_symlinks=False)
            size += about.st_blocks * _BLOCK
            changed = max(changed, about.st_mtime)
            held = held or (path.suffix == SUFFIX and is_held(path))
    return _RunFolder(folder, size, changed, held)


def _delete(folder: Path) -> None:
    """Delete a folder with its content. Two processes may do so at once. Raises `OSError`."""
    for path in sorted(folder.rglob("*"), reverse=True):  # what is in a folder stands behind it
        with contextlib.suppress(FileNotFoundError):
            path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink()
    with contextlib.suppress(FileNotFoundError):
        folder.rmdir()
