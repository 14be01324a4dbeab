"""Files that a process saves for the later ones: one that cannot be read counts as none."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from swarm.errors import RemoteError

T = TypeVar("T")

MAX_SIZE = 1 << 20
"""Bytes of a file that are read at most: ours are far smaller, and a damaged one may be larger than the memory."""


def read(path: Path, parse: Callable[[bytes], T], log: logging.Logger, otherwise: str) -> T | None:
    """Return what `parse` makes of the file's content, or of its first `MAX_SIZE` bytes; None where there is no file,
    or where it cannot be read, or `parse` raises `RemoteError`: then `otherwise` tells in the log what follows."""
    try:
        with path.open("rb") as file:
            return parse(file.read(MAX_SIZE))
    except FileNotFoundError:
        return None
    except (OSError, RemoteError) as error:
        log.warning("%s: %s; %s", path, error, otherwise)
        return None
