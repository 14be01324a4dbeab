"""Receives requests to start and stop apps in a simulation (`sim.control.app_requests`)."""

import contextlib
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path

import msgpack

from services.apps.loader import BUILT_IN
from sim.control import app_requests, datagrams
from sim.processes.processes import Processes
from swarm.errors import LocalError, SwarmError

_AT_ONCE = 8


class Orders:
    """The requests that reach a simulation. Its main thread, the only one that may start processes, calls `look`."""

    def __init__(
        self,
        run_dir: Path,
        processes: Processes,
        names: Sequence[str],
        start: Callable[[str, str, Sequence[str]], None],
    ) -> None:
        """`start(robot, app, settings)` starts an app that has not run yet; it raises `LocalError`."""
        self._processes, self._names, self._start = processes, names, start
        self._socket = datagrams.receiver(run_dir, app_requests.SOCKET)

    def look(self) -> list[str]:
        """Carry out the requests that have come. Return what was done, in words."""
        said = []
        arrived = datagrams.received(self._socket, app_requests.MAX_DATAGRAM)
        for datagram, sender in islice(arrived, _AT_ONCE):
            done = problem = ""
            try:
                done = self._carry_out(app_requests.unpack(datagram))
                said.append(done)
            except SwarmError as error:
                problem = str(error)
            if sender:
                with contextlib.suppress(OSError):  # who asked has gone
                    self._socket.sendto(msgpack.packb({"done": done, "problem": problem}), sender)
        return said

    def close(self) -> None:
        self._socket.close()

    def _carry_out(self, order: app_requests.AppRequest) -> str:
        unknown = [name for name in order.robots if name not in self._names]
        if unknown:
            raise LocalError(f"no robot {unknown[0]}, there are {', '.join(self._names)}")
        service = f"app/{order.app}"
        there = {name: child for name in order.robots if (child := self._processes.find(name, service)) is not None}
        if order.act == "stop":
            if not there:
                raise LocalError(f"{order.app} does not run on {' '.join(order.robots)}")
            for child in there.values():
                child.hold()
            return f"{order.app}: stopped on {' '.join(there)}"
        for name in order.robots:
            if name in there:
                there[name].release()
            elif order.app in BUILT_IN:
                self._start(name, order.app, order.settings)
            else:
                raise LocalError(
                    f"no app {order.app}: expected {', '.join(BUILT_IN)}, or the one that ran from the start"
                )
        return f"{order.app}: started on {' '.join(order.robots)}"
