"""Cutting the simulated radio: each end of a link is told by a datagram to its mesh's `sim:` transport."""

import socket
from pathlib import Path

import msgpack

SOCKET = "air.sock"


def silence(run_dir: Path, robot: str, peer: str, seconds: float) -> None:
    """Let nothing pass between `robot` and `peer` at the robot's end; a cut link wants both ends told.

    Raises OSError where the robot's mesh is not there.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.sendto(msgpack.packb({"cut": peer, "seconds": seconds}), str(run_dir / robot / SOCKET))
