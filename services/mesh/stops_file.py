"""The stops that a mesh knows, kept in the runtime directory: a mesh that is started anew goes on with them.

So its balancer stays stopped also while no neighbour can tell it. A boot clears them; balancers then start at rest.
"""

import logging
from pathlib import Path

from services.mesh.core.overlays.stop import Halt, from_file
from swarm.files import atomic_write
from swarm.process import file_reader
from swarm.process.paths import VOLATILE

NAME = "mesh.stops"

MAX_SIZE = 1 << 20
"""Bytes of a file that are read at most: a stop and a re-arm of 1000 robots have less than 0.2 MB."""

_log = logging.getLogger("mesh")


def load(directory: Path) -> Halt | None:
    """Return the stops that were kept; None where there are none."""
    return file_reader.read(directory / NAME, from_file, _log, "stops are heard of again from the neighbours", MAX_SIZE)


def save(directory: Path, data: bytes) -> None:
    """Keep them; raises OSError."""
    atomic_write(directory / NAME, data, unsynced=VOLATILE)
