"""What the process of an app keeps for the later processes of its run, until the robot's next boot."""

import logging
from pathlib import Path
from typing import Protocol, TypeVar

from swarm.files import atomic_write
from swarm.messages.codec import decode, encode
from swarm.process import file_reader
from swarm.process.paths import VOLATILE

_log = logging.getLogger("run_file")


class OfRun(Protocol):
    """A message that is kept for one run."""

    @property
    def run(self) -> int:
        """The run's number."""


T = TypeVar("T", bound=OfRun)


def read(kind: type[T], path: Path, run: int, otherwise: str) -> T | None:
    """Return what was kept for this run; None where that is nothing, or where the file cannot be read: `otherwise`
    tells in the log what follows from that."""
    kept = file_reader.read(path, lambda data: decode(kind, data, "its content"), _log, otherwise)
    return kept if kept is not None and kept.run == run else None


def write(path: Path, kept: OfRun) -> None:
    """Keep a message. Raises `OSError`."""
    atomic_write(path, encode(kept), unsynced=VOLATILE)
