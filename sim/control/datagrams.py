"""Datagrams to and within a running simulation: what people do to its robots comes by Unix sockets in its folders.

Each body of a running simulation listens on a socket in the robot's runtime directory. The balancer learns of an action
as a real one would, through its sensors.
"""

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sim.core.actions import BODY_SOCKET, SimulationAction, check, pack
from swarm.errors import LocalError
from swarm.process.paths import socket_path

_PATIENCE_S = 1.0
"""Only a receiver that is stopped makes a sender wait."""


def send(folder: Path, name: str, datagram: bytes, problem: str) -> None:
    """Send a datagram to the socket `name` in `folder`. Raises `LocalError` that begins with `problem` where nobody
    listens."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.settimeout(_PATIENCE_S)
        try:
            sock.sendto(datagram, str(socket_path(folder, name)))
        except OSError as error:
            raise LocalError(f"{problem} ({error.strerror})") from None


def send_action(robot: Path, action: SimulationAction) -> None:
    """Send a person's action to the simulated body with the runtime directory `robot`. Raises `LocalError` where the
    action is impossible or no body listens."""
    problem = f"the body of {robot.name} is not running at this moment"
    send(robot, BODY_SOCKET, pack(check(action)), problem)


def receiver(folder: Path, name: str) -> socket.socket:
    """Return a socket at which datagrams arrive; reads never wait. Raises `LocalError` where that is impossible."""
    path = socket_path(folder, name)
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        sock.bind(str(path))
    except OSError as error:
        sock.close()
        raise LocalError(f"{path}: {os.strerror(error.errno or 0)}") from None
    sock.setblocking(False)
    return sock


def received(sock: socket.socket, size: int) -> Iterator[tuple[bytes, Any]]:
    """Yield the datagrams that wait at a socket, cut to `size` bytes, each with its sender's address if it has one."""
    with contextlib.suppress(BlockingIOError):
        while True:
            yield sock.recvfrom(size)
