"""Files that a process saves for the later ones: one that cannot be read counts as none."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from swarm.errors import RemoteError

T = TypeVar("T")


def read(path: Path, parse: Callable[[bytes], T], log: logging.Logger, otherwise: str, most: int = -1) -> T | None:
    """Return what `parse` makes of the file's content, or of its first `most` bytes; None where there is no file, or
    where it cannot be read, or `parse` raises `RemoteError`: then `otherwise` tells in the log what follows."""
    try:
        with path.open("rb") as file:
            return parse(file.read(most))
    except FileNotFoundError:
        return None
    except (OSError, RemoteError) as error:
        log.warning("%s: %s; %s", path, error, otherwise)
        return None
