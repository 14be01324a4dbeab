"""`tcp:` links, over Wi-Fi or Ethernet."""

import socket
from collections.abc import Collection

from services.mesh.core.callers import UNKNOWN, Caller
from services.mesh.links.pipe import Pipe, describe
from services.mesh.monikers import Tcp
from swarm.errors import LocalError

DIAL_TIMEOUT = 5.0
"""s; Bluetooth's own page time-out is 5.1 s."""

SEND_BUFFER = 50_000
"""Bytes the kernel may hold; about what RFCOMM does (40 credits x 127 bytes x 10)."""


def dial(address: Tcp) -> Pipe:
    """Connect; raises OSError."""
    sock = socket.create_connection((address.host, address.port), timeout=DIAL_TIMEOUT)
    return _pipe(sock)


class Listener:
    """Where `tcp:` neighbours reach this robot."""

    def __init__(self, address: Tcp, neighbours: Collection[str] = ()) -> None:
        """`neighbours` are the numeric addresses that neighbours call from."""
        self._neighbours = frozenset(neighbours)
        family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
        try:
            self._sock = socket.create_server((address.host, address.port), family=family)
        except OSError as error:
            raise LocalError(f"[mesh] listen: {address.host}:{address.port}: {describe(error)}") from None
        self._sock.setblocking(False)

    def fileno(self) -> int:
        """For select."""
        return self._sock.fileno()

    def accept(self) -> Pipe:
        """The next caller; raises OSError where it has gone already."""
        sock, address = self._sock.accept()
        source: str = address[0]
        return _pipe(sock, Caller(source, reserved=source in self._neighbours))

    def close(self) -> None:
        """Stop listening."""
        self._sock.close()


def _pipe(sock: socket.socket, caller: Caller = UNKNOWN) -> Pipe:
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
    return Pipe(sock, caller)
