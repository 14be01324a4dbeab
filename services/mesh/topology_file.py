"""The topology in force, kept in the robot's state directory: a mesh that is started anew goes on with it.

Its checksum tells a damaged file, which counts for nothing.
"""

import logging
from pathlib import Path

from services.mesh.core.routing.topology import Ground, TopologyVersion
from swarm.process import file_reader

NAME = "topology"

_log = logging.getLogger("mesh")


def load(directory: Path, ground: Ground) -> TopologyVersion | None:
    """Return the value that was kept; None where there is none of this configuration."""
    path = directory / NAME

    def parse(data: bytes) -> TopologyVersion | None:
        value = ground.from_file(data)
        if value is None:
            _log.info("%s: of another configuration, so this one's topology holds", path)
        return value

    return file_reader.read(path, parse, _log, "the configuration's topology holds until a neighbour knows better")
