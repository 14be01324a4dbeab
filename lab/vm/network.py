"""A machine's network: a wire to this host alone, at which its ssh answers.

The interface is there as long as the machine is switched on, and so is nobody else's. Nothing of the host is forwarded.
"""

import errno
import socket

from lab.vm.shell import sh
from swarm.errors import LocalError

MOST = 64
"""Machines of a host at once."""


class Wire:
    """Two addresses of 10.78.0.0/16, the host's and the machine's, that are no other machine's until it is closed."""

    def __init__(self) -> None:
        self._lock = socket.socket(socket.AF_UNIX)
        self._number = self._take()
        self.interface = f"lab{self._number}"
        """The host's end of it, made by the machine when it is switched on."""
        self.host, self.machine = f"10.78.{self._number}.1", f"10.78.{self._number}.2"

    def _take(self) -> int:
        """The lowest number that no process of this host has: a name of a socket goes with the process that has it."""
        for number in range(MOST):
            try:
                self._lock.bind(f"\0balboa-swarm-lab-{number}")
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise
            else:
                return number
        raise LocalError(f"{MOST} machines of the lab are switched on already")

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
