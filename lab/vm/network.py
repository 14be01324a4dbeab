"""A machine's network: a wire to this host alone, at which its ssh answers.

The interface is there as long as the machine is switched on, and so is nobody else's. Nothing of the host is forwarded.
"""

import errno
import socket
from pathlib import Path

from lab.vm.shell import sh
from swarm.errors import LocalError

MOST = 64
"""Machines of a host at once."""

INTERFACES = Path("/sys/class/net")
"""All interfaces of this host by name."""


class Wire:
    """Two addresses of 10.78.0.0/16, the host's and the machine's, that are no other machine's until it is closed."""

    def __init__(self) -> None:
        self._lock, self._number = _take()
        self.interface = _interface(self._number)
        """The host's end of it, made by the machine when it is switched on."""
        self.host, self.machine = f"10.78.{self._number}.1", f"10.78.{self._number}.2"

    def up(self) -> None:
        """Once the machine has switched its end on.

        The host hands over no frame that the wire could not carry: the machine's driver offers to take such (GSO), has
        room for 1500 bytes, and throws them away ("Incoming GSO frames and GRO disabled"). A large input over ssh then
        stood still until ssh gave the robot up.
        """
        sh("ip", "address", "replace", f"{self.host}/30", "dev", self.interface)
        sh("ip", "link", "set", self.interface, "up", "gso_max_segs", "1")

    def close(self) -> None:
        """Another machine may have the addresses."""
        self._lock.close()


def _interface(number: int) -> str:
    return f"lab{number}"


def _take() -> tuple[socket.socket, int]:
    """Return a socket and the lowest free number. The number is taken as long as the socket is open: its name goes with
    the process that has it.

    A machine whose test was killed may leave a process that holds its interface. Another machine cannot have that
    interface, and would boot without a network: its number is not free.
    """
    for number in range(MOST):
        lock = socket.socket(socket.AF_UNIX)
        try:
            lock.bind(f"\0balboa-swarm-lab-{number}")
        except OSError as error:
            lock.close()
            if error.errno != errno.EADDRINUSE:
                raise
            continue
        if not (INTERFACES / _interface(number)).exists():
            return lock, number
        lock.close()
    raise LocalError(f"{MOST} machines of the lab are switched on already")
