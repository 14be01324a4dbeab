"""The stops that a mesh knows, kept in the robot's state directory: a mesh that is started anew goes on with them.

So its balancer stays stopped also while no neighbour can tell it, and after a boot. A file that cannot be read may have
held a stop, so it counts as one.
"""

import logging
from pathlib import Path

from services.mesh.core.overlays.stop import Halt, Mark, from_file, without_greatest
from swarm.process import file_reader

NAME = "mesh.stops"

_log = logging.getLogger("mesh")


def load(directory: Path, robot: str, incarnation: int) -> Halt | None:
    """Return the stops that were kept; None where there are none. Where they cannot be read, return a stop that this
    start of `robot` gives."""
    path = directory / NAME
    first = Mark(incarnation, 1)
    kept = file_reader.read(path, from_file, _log, "the swarm is stopped, since this may have been a stop")
    if kept is not None:
        return without_greatest(kept, robot, first)
    if path.exists():
        return Halt({robot: (first, "the stops that the mesh kept cannot be read")}, {})
    return None
