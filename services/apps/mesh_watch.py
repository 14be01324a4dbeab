"""An app's process that hears nothing of its robot's mesh, although the mesh runs, opens its session of the bus anew.

Zenoh connects the two processes directly, and the router passes no messages between them. On an overloaded machine such
a connection once broke and Zenoh made no other one: the lockstep stood still for good.
"""

import contextlib
import socket
from collections.abc import Callable

from swarm.messages.keys import key
from swarm.process.paths import socket_of
from swarm.process.runtime import Runtime

LOOK_S = 1.0
"""Seconds between two looks; the mesh tells of its links as often."""

SILENT = 10
"""If nothing of the mesh has arrived before so many looks in a row, the session is opened anew. Looks are counted, not
seconds: a process that got no processor time could hear nothing."""

MOST_SILENT = 320
"""Each new session in which nothing arrives either doubles the number of looks, up to this one."""


class MeshWatch:
    """Watches over the connection of one process with the mesh."""

    def __init__(self, runtime: Runtime, is_there: Callable[[], bool], renew: Callable[[], None]) -> None:
        """`is_there()` says whether the mesh's process runs; `renew` is `Bus.renew`."""
        self._runtime = runtime
        self._is_there = is_there
        self._renew = renew
        self._silent = 0
        self._patience = SILENT
        runtime.bus.subscribe(key(runtime.robot, "mesh", "links"), self._heard)
        runtime.at(runtime.now + LOOK_S, self._look)

    def _heard(self, _name: str, _payload: bytes) -> None:
        self._silent, self._patience = 0, SILENT

    def _look(self) -> None:
        self._runtime.at(self._runtime.now + LOOK_S, self._look)
        self._silent += 1
        if self._silent < self._patience:
            return
        self._silent = 0
        if self._is_there():
            self._patience = min(2 * self._patience, MOST_SILENT)
            self._runtime.counters["bus_renewed"] += 1
            self._runtime.log.warning("nothing of the mesh arrives although it runs: the bus is opened anew")
            self._renew()


def is_listening(endpoint: str) -> bool:
    """Return whether a process listens at this endpoint of the bus. The socket of a killed process is still there, but
    refuses connections."""
    with contextlib.closing(socket.socket(socket.AF_UNIX)) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(socket_of(endpoint)))
        except OSError:
            return False
        return True
