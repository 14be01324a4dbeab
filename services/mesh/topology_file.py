"""The topology in force, kept in the robot's state directory: a mesh that is started anew goes on with it.

Its checksum tells a damaged file, which counts for nothing.
"""

import logging
from pathlib import Path

from services.mesh.core.routing.topology import Ground, TopologyVersion
from swarm.errors import FrameError
from swarm.files import atomic_write, make_folder

NAME = "topology"

_log = logging.getLogger("mesh")


def load(directory: Path, ground: Ground) -> TopologyVersion | None:
    """Return the value that was kept; None where there is none of this configuration."""
    path = directory / NAME
    try:
        value = ground.from_file(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, FrameError) as error:
        _log.warning("%s: %s; the configuration's topology holds until a neighbour knows better", path, error)
        return None
    if value is None:
        _log.info("%s: of another configuration, so this one's topology holds", path)
    return value


def save(directory: Path, data: bytes) -> None:
    """Keep it; raises OSError."""
    make_folder(directory)
    atomic_write(directory / NAME, data)
