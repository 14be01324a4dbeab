"""The short way between processes of a robot: datagrams that hold several keys' messages.

What apps in lockstep send each other is most of what a robot's bus would carry, and the balancer's odometry most of the
rest; each message on the bus wakes seven threads of three processes. A datagram wakes the one that waits for it, or
nobody until its receiver looks. It is the same message under the same key. Between the mesh and the hosts of apps the
way over the bus stays: whoever finds nobody at the other end, or no room, publishes.
"""

import contextlib
import os
import socket
from collections.abc import Iterable
from pathlib import Path

from swarm.bus import batch
from swarm.errors import LocalError
from swarm.process.paths import socket_path

MESH = "mesh.lane"
"""Where a mesh listens, in the robot's runtime directory."""

DWM = "dwm.lane"
"""Where the UWB service finds odometry."""

_LARGEST = 256 * 1024
"""Bytes of a datagram; the kernel's default buffers hold 208 KiB, and ten datagrams."""


def of_app(app: str) -> str:
    """Where the host of an app listens."""
    return f"app.{app}.lane"


class Sender:
    """Sends to the ends of lanes; never waits, and any thread may do it."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)

    def send(self, name: str, parts: Iterable[tuple[str, bytes]]) -> bool:
        """Keys and payloads to the end of that name; False where it is not there or does not listen."""
        try:
            self._sock.sendto(batch.pack(parts), socket.MSG_DONTWAIT, f"{self._directory}/{name}")
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Send no more."""
        self._sock.close()


class Lane(Sender):
    """One end. A socket file that a killed process left is replaced, so whoever makes an end is alone in that: a host
    by its lock, a mesh by the addresses where it listens, the UWB service by its port."""

    def __init__(self, directory: Path, name: str) -> None:
        """Raises `LocalError` where no socket can be had, `BusError` where the directory's path is too long for one."""
        self._path = socket_path(directory, name)
        super().__init__(directory)
        self._waker = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._path.unlink(missing_ok=True)
            self._sock.bind(os.fspath(self._path))
            self._waker.connect(os.fspath(self._path))
        except OSError as error:
            self._sock.close()
            self._waker.close()
            raise LocalError(f"{self._path}: {error.strerror}") from None

    def fileno(self) -> int:
        """For select."""
        return self._sock.fileno()

    def take(self) -> bytes | None:
        """The next datagram; None where there is none now. One that is empty comes of `wake`: who takes it from others
        that wait is to wake them."""
        try:
            return self._sock.recv(_LARGEST, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return None

    def wait(self) -> bytes | None:
        """The next datagram; None after `wake`."""
        return self._sock.recv(_LARGEST) or None

    def wake(self) -> None:
        """Whoever waits comes back, or who will next."""
        with contextlib.suppress(BlockingIOError):  # then there are others, which do as well
            self._waker.send(b"", socket.MSG_DONTWAIT)

    def close(self) -> None:
        """Leave, when nobody waits any more."""
        self._path.unlink(missing_ok=True)
        self._waker.close()
        super().close()
