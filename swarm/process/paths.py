"""The runtime directory of a robot's processes, and the names in it.

On a robot it is /run/swarm (systemd's RuntimeDirectory); a simulation gives each robot one of its own through
SWARM_RUNTIME. Everything in it may vanish at a reboot; what may not is in the state directory.
"""

import os
from pathlib import Path

from swarm.errors import BusError

DEFAULT_RUNTIME = Path("/run/swarm")
DEFAULT_STATE = Path("/var/lib/swarm")

MAX_SOCKET_PATH = 107
"""Bytes of a Unix socket's path without the closing zero: sun_path of unix(7) has 108."""

BUS_SOCKET = "bus.sock"

GYRO_ZERO = "balancer.zero"
"""The file in which a balancing loop keeps its gyro's zero, and when it last used it: once a second while it runs."""

VOLATILE = "a boot clears the runtime directory"
"""Why files in the runtime directory need not be on a disk (`swarm.files.atomic_write`)."""

ENDPOINT_PROTOCOL = "unixsock-stream"
"""Zenoh's name for a Unix socket."""


def runtime_dir() -> Path:
    """Return the runtime directory of the robot this process belongs to."""
    return Path(os.environ.get("SWARM_RUNTIME") or DEFAULT_RUNTIME)


def state_dir() -> Path:
    """Return the directory for data that survives a reboot: SWARM_STATE, else the runtime directory where one was
    given (tests do so), else /var/lib/swarm (systemd's StateDirectory)."""
    return Path(os.environ.get("SWARM_STATE") or os.environ.get("SWARM_RUNTIME") or DEFAULT_STATE)


def socket_path(directory: Path, name: str) -> Path:
    """`directory/name`, checked to fit a Unix socket's address; `BusError` says what to do if it does not."""
    path = directory / name
    length = len(os.fsencode(path))
    if length > MAX_SOCKET_PATH:
        raise BusError(
            f"{path}: {length} bytes, but a Unix socket's path holds at most {MAX_SOCKET_PATH}; use a shorter directory"
        )
    return path


def bus_endpoint(directory: Path, service: str = "") -> str:
    """Return the Zenoh endpoint of the router with this runtime directory, or that of a service there which others
    reach directly; `BusError` where it can be none."""
    path = socket_path(directory, f"bus.{service.replace('/', '.')}.sock" if service else BUS_SOCKET)
    if odd := set(str(path)) & set("?#"):
        # Zenoh would cut the path there and listen somewhere else.
        raise BusError(f"{path}: a runtime directory cannot have {odd.pop()!r} in its path; use another directory")
    return f"{ENDPOINT_PROTOCOL}/{path}"
