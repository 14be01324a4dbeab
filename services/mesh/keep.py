"""The topology in force, kept in the robot's state directory: a mesh that is started anew goes on with it.

A whole new file is put in the place of the old one, on disk before it has that name: whenever the power fails, there is
the old one or the new one. Its checksum tells a damaged one, which counts for nothing.
"""

import logging
import os
from pathlib import Path

from services.mesh.core.topology import Ground, Topology
from swarm.errors import FrameError

NAME = "topology"

_log = logging.getLogger("mesh")


def load(directory: Path, ground: Ground) -> Topology | None:
    """What was kept; None where there is nothing, or nothing of this configuration."""
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
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / NAME
    new = path.with_suffix(".new")
    with new.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
