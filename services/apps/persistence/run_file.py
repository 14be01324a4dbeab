"""What the process of an app keeps for the later processes of its run, until the robot's next boot."""

import logging
from pathlib import Path
from typing import Protocol, TypeVar

from swarm.errors import PayloadError
from swarm.files import atomic_write
from swarm.messages.codec import decode, encode
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
    try:
        kept = decode(kind, path.read_bytes(), str(path))
    except FileNotFoundError:
        return None
    except (OSError, PayloadError) as error:
        _log.warning("%s; %s", error, otherwise)
        return None
    return kept if kept.run == run else None


def write(path: Path, kept: OfRun) -> None:
    """Keep a message. Raises `OSError`."""
    atomic_write(path, encode(kept), unsynced=VOLATILE)
