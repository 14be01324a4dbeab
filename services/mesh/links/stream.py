"""The common part of links over connected stream sockets, whatever their address family: `tcp:` and `rfcomm:`."""

import socket
from typing import Any

from services.mesh.links.pipe import Pipe

BACKLOG = 16
"""Callers the kernel holds until they are accepted."""


class StreamListener:
    """A listening socket whose callers become pipes."""

    def __init__(self, sock: socket.socket) -> None:
        """`sock` is bound and listens; it is closed with this."""
        sock.setblocking(False)
        self._sock = sock

    def fileno(self) -> int:
        return self._sock.fileno()

    def accept(self) -> Pipe:
        """Return the next caller; raises OSError where it has gone already."""
        sock, address = self._sock.accept()
        return self._adopt(sock, address)

    def close(self) -> None:
        self._sock.close()

    def _adopt(self, sock: socket.socket, address: Any) -> Pipe:
        """Make the caller at `address` a pipe."""
        raise NotImplementedError
