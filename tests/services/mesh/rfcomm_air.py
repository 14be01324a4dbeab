"""A stand-in for the kernel's RFCOMM sockets: Unix sockets that fail as those were seen to fail on Linux 6.12."""

import errno
import itertools
import os
import socket
import threading
import time
from typing import Any

from services.mesh.links.rfcomm import BT_SECURITY, RFCOMM_LM, SOL_BLUETOOTH, SOL_RFCOMM


def fault(number: int) -> OSError:
    return OSError(number, os.strerror(number))


class RfcommAir:
    """Adapters, who listens where, and who hears whom."""

    _numbers = itertools.count()

    def __init__(self, *adapters: str) -> None:
        self.adapters = set(adapters)
        self.out_of_range: set[str] = set()
        self.page_timeout = 0.0
        self.listening: dict[tuple[str, int], str] = {}
        self.calling: list[str] = []
        """Adapters whose connection was not accepted yet."""
        self.in_vain: list[str] = []
        """Adapters that were called and did not answer."""
        self.pairs: set[tuple[str, str]] = set()
        self.sockets: list[RfcommSocket] = []
        self.lock = threading.Lock()

    def open(self) -> "RfcommSocket":
        made = RfcommSocket(self)
        self.sockets.append(made)
        return made

    def path(self) -> str:
        return f"\0rfcomm-{os.getpid()}-{next(self._numbers)}"


class RfcommSocket(socket.socket):
    """One end of a connection, or a listener."""

    def __init__(self, air: RfcommAir, fileno: int | None = None) -> None:
        super().__init__(socket.AF_UNIX, socket.SOCK_STREAM, 0, fileno)
        self.air = air
        self.adapter = ""
        self.channel = 0
        self.security: bytes | None = None
        self.link_mode = 0
        self.over: int | None = None
        """Error of the connection's end, once it was told."""
        self.silent = False
        """Whether the radio is gone: the next read finds the supervision time-out."""

    def setsockopt(self, level: int, option: int, value: Any) -> None:  # type: ignore[override]
        if (level, option) == (SOL_BLUETOOTH, BT_SECURITY):
            self.security = value
        elif (level, option) == (SOL_RFCOMM, RFCOMM_LM):
            self.link_mode = value
        else:
            super().setsockopt(level, option, value)

    def bind(self, address: Any) -> None:
        self.adapter, self.channel = address
        if self.adapter not in self.air.adapters:
            raise fault(errno.EHOSTUNREACH)
        if self.channel:
            if address in self.air.listening:
                raise fault(errno.EADDRINUSE)
            self.air.listening[address] = path = self.air.path()
            super().bind(path)

    def connect(self, address: Any) -> None:
        peer = address[0]
        if peer not in self.air.adapters or peer in self.air.out_of_range:
            time.sleep(self.air.page_timeout)
            self.air.in_vain.append(peer)
            raise fault(errno.EHOSTDOWN)
        if (self.adapter, peer) in self.air.pairs:
            raise fault(errno.EBUSY)
        if address not in self.air.listening:
            raise fault(errno.ECONNREFUSED)
        with self.air.lock:
            self.air.pairs.add((self.adapter, peer))
            self.air.calling.append(self.adapter)
            self.peer = peer
            super().connect(self.air.listening[address])

    def accept(self) -> tuple[Any, Any]:
        descriptor, _ = self._accept()
        with self.air.lock:
            made = RfcommSocket(self.air, descriptor)
            self.air.sockets.append(made)
            return made, (self.air.calling.pop(0), 0)

    def recv(self, size: int, flags: int = 0) -> bytes:
        if self.over is not None:
            raise BlockingIOError  # the error was given once; a second recv waits for ever
        if self.silent:
            self.over = errno.ETIMEDOUT
            raise fault(errno.ETIMEDOUT)
        data = super().recv(size, flags)
        if not data:
            self.over = errno.ECONNRESET
            raise fault(errno.ECONNRESET)
        return data

    def send(self, data: Any, flags: int = 0) -> int:
        if self.over is not None:
            raise fault(errno.ENOTCONN)
        try:
            return super().send(data, flags)
        except BrokenPipeError:
            # The first to touch the socket is told, the reader finds nothing any more.
            self.over = errno.ECONNRESET
            raise fault(errno.ECONNRESET) from None

    def close(self) -> None:
        self.air.listening.pop((self.adapter, self.channel), None)
        self.air.pairs.discard((self.adapter, getattr(self, "peer", "")))
        super().close()
