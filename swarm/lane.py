"""The short way between a robot's mesh and the hosts of its apps: datagrams that hold several keys' messages.

What apps in lockstep send each other is most of what a robot's bus would carry, and each message on the bus wakes
seven threads of three processes. A datagram wakes the one that waits for it. It is the same message under the same key,
and the way over the bus stays: whoever finds nobody at the other end, or no room, publishes.
"""

import contextlib
import os
import select
import socket
from collections.abc import Iterable
from pathlib import Path

from swarm.core import together
from swarm.errors import LocalError
from swarm.paths import socket_path

MESH = "mesh.lane"
"""Where a mesh listens, in the robot's runtime directory."""

_LARGEST = 256 * 1024
"""Bytes of a datagram; the kernel's default buffers hold 208 KiB."""


def of_app(app: str) -> str:
    """Where the host of an app listens."""
    return f"app.{app}.lane"


class Lane:
    """One end; sending never waits, and any thread may do it. A socket file that a killed process left is replaced, so
    whoever makes an end is alone in that: a host by its lock, a mesh by the addresses where it listens."""

    def __init__(self, directory: Path, name: str) -> None:
        """Raises `LocalError` where no socket can be had, `BusError` where the directory's path is too long for one."""
        self._directory = directory
        self._path = socket_path(directory, name)
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._path.unlink(missing_ok=True)
            self._sock.bind(os.fspath(self._path))
        except OSError as error:
            self._sock.close()
            raise LocalError(f"{self._path}: {error.strerror}") from None
        self._woken = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def fileno(self) -> int:
        """For select."""
        return self._sock.fileno()

    def send(self, name: str, parts: Iterable[tuple[str, bytes]]) -> bool:
        """Keys and payloads to the end of that name; False where it is not there or does not listen."""
        try:
            self._sock.sendto(together.pack(parts), socket.MSG_DONTWAIT, f"{self._directory}/{name}")
        except OSError:
            return False
        return True

    def take(self) -> bytes | None:
        """The next datagram; None where there is none now."""
        try:
            return self._sock.recv(_LARGEST, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return None

    def wait(self) -> bytes | None:
        """The next datagram; None after `wake`."""
        readable, _, _ = select.select([self._sock.fileno(), self._woken], [], [])
        if self._woken in readable:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._woken)
        return self.take()

    def wake(self) -> None:
        """Whoever waits comes back, or who will next."""
        os.eventfd_write(self._woken, 1)

    def close(self) -> None:
        """Leave, when nobody waits any more."""
        self._path.unlink(missing_ok=True)
        self._sock.close()
        os.close(self._woken)
