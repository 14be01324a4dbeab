"""`tcp:` links, over Wi-Fi or Ethernet."""

import errno
import logging
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

_IP_FREEBIND = 15
"""From linux/in.h; Python has no name for it. It holds for IPv6, too."""

_log = logging.getLogger("mesh")


def dial(address: Tcp) -> Pipe:
    """Connect. Raises OSError."""
    sock = socket.create_connection((address.host, address.port), timeout=DIAL_TIMEOUT)
    return _pipe(sock)


class TcpListener(stream.StreamListener):
    """A listener for `tcp:` neighbours of this robot."""

    def __init__(self, address: Tcp, neighbours: Collection[str] = ()) -> None:
        """`neighbours` are the numeric addresses that neighbours call from."""
        self._neighbours = frozenset(neighbours)
        sock = None
        try:
            sock = socket.socket(socket.AF_INET6 if ":" in address.host else socket.AF_INET)
            if sock.family == socket.AF_INET6:
                sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            _bind(sock, address)
            sock.listen(stream.BACKLOG)
        except OSError as error:
            if sock is not None:
                sock.close()
            raise LocalError(f"[mesh] listen: {address.host}:{address.port}: {describe(error)}") from None
        super().__init__(sock)

    def _adopt(self, sock: socket.socket, address: Any) -> Pipe:
        source: str = address[0]
        return _pipe(sock, Caller(source, reserved=source in self._neighbours))


def _bind(sock: socket.socket, address: Tcp) -> None:
    """Take an address, also one that the robot gets later: on a boot the mesh may be up before the Wi-Fi is."""
    try:
        sock.bind((address.host, address.port))
    except OSError as error:
        if error.errno != errno.EADDRNOTAVAIL:
            raise
        _log.warning("[mesh] listen: nobody can call yet, this robot has no address %s", address.host)
        sock.setsockopt(socket.SOL_IP, _IP_FREEBIND, 1)
        sock.bind((address.host, address.port))


def _pipe(sock: socket.socket, caller: Caller = UNKNOWN) -> Pipe:
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
    return Pipe(sock, caller)
