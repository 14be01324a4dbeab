"""The stops that a mesh knows, kept in the runtime directory: a mesh that is started anew goes on with them.

So its balancer stays stopped also while no neighbour can tell it. A boot clears them; balancers then start at rest.
A file that cannot be read may have held a stop, so it counts as one.
"""

import logging
from pathlib import Path

from services.mesh.core.overlays.stop import Halt, Mark, from_file
from swarm.files import atomic_write
from swarm.process import file_reader
from swarm.process.paths import VOLATILE

NAME = "mesh.stops"

_log = logging.getLogger("mesh")


def load(directory: Path, robot: str, incarnation: int) -> Halt | None:
    """Return the stops that were kept; None where there are none. Where they cannot be read, return a stop that this
    start of `robot` gives."""
    path = directory / NAME
    kept = file_reader.read(path, from_file, _log, "the swarm is stopped, since this may have been a stop")
    if kept is None and path.exists():
        return Halt({robot: (Mark(incarnation, 1), "the stops that the mesh kept cannot be read")}, {})
    return kept


def save(directory: Path, data: bytes) -> None:
    """Keep them; raises OSError."""
    atomic_write(directory / NAME, data, unsynced=VOLATILE)
