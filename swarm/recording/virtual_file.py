"""A recording without clock and threads, for virtual time: same messages, same bytes."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

from swarm.errors import LocalError
from swarm.recording.core.writer import Writer
from swarm.recording.file import LIBRARY
from swarm.recording.reader import CLOCK, EPOCH, RUN

VIRTUAL = "virtual"
"""Names the clock of virtual time, which begins at 0."""


class DirectRecording:
    """One file for a whole run, robots told apart by the topics. Raises `LocalError` where it cannot be written."""

    def __init__(self, path: Path, run: Mapping[str, str], clock: str = VIRTUAL) -> None:
        """`run`: what is to be known of the run (`folder.describe`); `clock` names what its times are of."""
        self._path = path
        self._writer = Writer(LIBRARY, epoch_ns=0)
        self._writer.metadata(RUN, {**run, EPOCH: "0", CLOCK: clock})
        try:
            self._file = path.open("x+b")
        except OSError as error:
            raise LocalError(f"{path}: cannot be written: {error.strerror}") from None

    def metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Note something about the whole recording."""
        self._writer.metadata(name, entries)

    def write(self, topic: str, t: float, message: object, name: str = "") -> None:
        """Record a message; see `Writer.write`."""
        self._writer.write(topic, t, message, name)
        if self._writer.ready:
            self.flush()

    def flush(self) -> None:
        """Put into the file the chunks that are complete. (An open one is not ended: that would change the bytes.)"""
        try:
            self._file.write(self._writer.take())
        except OSError as error:
            raise LocalError(f"{self._path}: cannot be written: {error.strerror}") from None

    def close(self) -> None:
        try:
            finish(self._writer, self._file)
            self._file.close()
        except OSError as error:
            raise LocalError(f"{self._path}: cannot be written: {error.strerror}") from None


def finish(writer: Writer, file: BinaryIO) -> None:
    """Write a file's end, piece by piece, into a file that can be read, too."""

    def read(at: int, length: int) -> bytes:
        file.seek(at)
        return file.read(length)

    for piece in writer.finish(read):
        file.seek(0, os.SEEK_END)
        file.write(piece)
