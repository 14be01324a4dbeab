"""`tcp:` links, over Wi-Fi or Ethernet."""

import socket
from collections.abc import Collection
from typing import Any

from services.mesh.core.link.calls import UNKNOWN, Caller
from services.mesh.link_address import Tcp
from services.mesh.links import stream
from services.mesh.links.pipe import Pipe, describe
from swarm.errors import LocalError

DIAL_TIMEOUT = 5.0
"""s; Bluetooth's own page time-out is 5.1 s."""

SEND_BUFFER = 50_000
"""Bytes the kernel may hold; about what RFCOMM does (40 credits x 127 bytes x 10)."""


def dial(address: Tcp) -> Pipe:
    """Connect. Raises OSError."""
    sock = socket.create_connection((address.host, address.port), timeout=DIAL_TIMEOUT)
    return _pipe(sock)


class TcpListener(stream.StreamListener):
    """A listener for `tcp:` neighbours of this robot."""

    def __init__(self, address: Tcp, neighbours: Collection[str] = ()) -> None:
        """`neighbours` are the numeric addresses that neighbours call from."""
        self._neighbours = frozenset(neighbours)
        family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
        try:
            sock = socket.create_server((address.host, address.port), family=family, backlog=stream.BACKLOG)
        except OSError as error:
            raise LocalError(f"[mesh] listen: {address.host}:{address.port}: {describe(error)}") from None
        super().__init__(sock)

    def _adopt(self, sock: socket.socket, address: Any) -> Pipe:
        source: str = address[0]
        return _pipe(sock, Caller(source, reserved=source in self._neighbours))


def _pipe(sock: socket.socket, caller: Caller = UNKNOWN) -> Pipe:
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
    return Pipe(sock, caller)
