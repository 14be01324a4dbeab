"""A file that a mesh keeps for its next start, written by a thread of its own.

An SD card may take seconds for it, and neighbours take a link for dead that is silent for 3 s.
"""

import threading
from pathlib import Path

from services.mesh.links.pipe import describe
from swarm.files import atomic_write, make_folder

PAUSE_S = 1.0
"""Seconds after a write until the next one, so that news in a loop do not wear the card; or until one that has failed
is tried again."""
_END_S = 1.0
"""Seconds that the last write has when the mesh ends, which systemd gives 5 s."""


def save(path: Path, data: bytes) -> None:
    """Write a file whole, in a folder that may be missing. Raises OSError."""
    make_folder(path.parent)
    atomic_write(path, data)


class FileWriter:
    """Writes the newest content that it was given."""

    def __init__(self, what: str, path: Path) -> None:
        """`what` names the content in `problem`."""
        self.problem = ""
        """Why the newest content is not kept, in words; empty where it is, or is about to be."""
        self._what = what
        self._path = path
        self._news = threading.Condition()
        self._data: bytes | None = None
        """The content that is not written yet."""
        self._ending = False
        self._thread = threading.Thread(target=self._run, name="file", daemon=True)
        self._thread.start()

    def keep(self, data: bytes) -> None:
        """Have the file hold this. Any thread may call it, and none waits."""
        with self._news:
            self._data = data
            self._news.notify()

    def close(self) -> None:
        """Wait for the last write, but not for a disk that hangs."""
        with self._news:
            self._ending = True
            self._news.notify()
        self._thread.join(_END_S)

    def _run(self) -> None:
        while (data := self._next()) is not None:
            failed = None
            try:
                save(self._path, data)
                self.problem = ""
            except OSError as error:
                self.problem = f"{self._what} cannot be kept through a restart: {self._path.parent}: {describe(error)}"
                failed = data
            self._pause(failed)

    def _next(self) -> bytes | None:
        """Wait for content and return it; None at the end."""
        with self._news:
            self._news.wait_for(lambda: self._data is not None or self._ending)
            data, self._data = self._data, None
            return data

    def _pause(self, failed: bytes | None) -> None:
        """Wait a while, then have the content that could not be written be the next, unless there is a newer one."""
        with self._news:
            self._news.wait_for(lambda: self._ending, PAUSE_S)
            if self._data is None and not self._ending:
                self._data = failed
