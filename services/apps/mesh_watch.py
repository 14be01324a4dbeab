"""Notices that an app's process hears nothing of the mesh although the mesh runs, and has its bus opened anew.

Zenoh connects the two directly, and the router passes nothing between them. Where such a connection broke on an
overloaded machine and Zenoh made no other, a lockstep stood still for ever.
"""

import contextlib
import socket
from collections.abc import Callable

from swarm.messages.keys import key
from swarm.process.paths import ENDPOINT_PROTOCOL
from swarm.process.runtime import Runtime

LOOK_S = 1.0
"""Seconds between two looks; the mesh tells of its links as often."""

SILENT = 10
"""Looks in a row without a word of the mesh after which the bus is opened anew. Counted, not timed: a process that got
no processor time has heard nothing meanwhile."""

MOST_SILENT = 320
"""The same after many times in a row in vain: each one doubles it."""


class MeshWatch:
    """The watch of one process."""

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
    """Return whether a process listens at this endpoint of the bus: the socket of one that was killed is still there,
    but refuses."""
    with contextlib.closing(socket.socket(socket.AF_UNIX)) as probe:
        probe.setblocking(False)
        try:
            probe.connect(endpoint.removeprefix(f"{ENDPOINT_PROTOCOL}/"))
        except OSError:
            return False
        return True
