"""`python -m sim.processes.radio`: the process that simulates the Bluetooth radio of all robots (`--radio slots`).

It runs the slots of `sim.slots` on the real clock. The robots' meshes reach it by the sockets of
`services.mesh.links.slots`. Where the machine is busy, it is late: it then goes through the slots that it has missed in
their order, so frames arrive late and nothing else changes. After `MOST_LATE` without CPU time the radio has stood
still for the rest: its robots have been silent for so long anyway.
"""

import argparse
import contextlib
import json
import logging
import os
import select
import signal
import socket
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from services.mesh import link_address
from services.mesh.links.sim import bound, cuts_in, precise_timers
from services.mesh.links.slots import (
    MAX_PACKET,
    RADIO_SOCKET,
    RadioAnswer,
    RadioCall,
    RadioCut,
    RadioSupervise,
    Request,
    call_from,
)
from sim.slots.connections import SOCKET, End, RadioConnections
from sim.slots.devices import RadioLink
from sim.slots.parameters import SlotParameters
from sim.virtual.events import EventQueue
from swarm import clock
from swarm.config import load
from swarm.messages.codec import decode_any, encode
from swarm.process import log
from swarm.process.edges import die_with_parent, run
from swarm.process.paths import runtime_dir, socket_path

LOOK_EVERY = 0.1
"""Seconds between two looks whether the mesh of a robot is there that was not."""

MOST_LATE = 1.0
"""Seconds of slots that are made up for after a time without CPU time."""

ROUNDING = 1e-9
"""Seconds by which the sum of two times may be too small."""

LATENESS = "lateness.json"
"""The file in its directory in which the process writes at its end how late it was."""

_KINDS: tuple[type[Request], ...] = (RadioCall, RadioSupervise, RadioCut)

_log = logging.getLogger("radio")


class SocketEnd(End):
    """One end of a connection: a socket to the mesh of its robot."""

    def __init__(self, robot: str, link: RadioLink, sock: socket.socket, server: "RadioServer") -> None:
        super().__init__(robot, link)
        self.sock = sock
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SOCKET // 2)  # the kernel doubles it
        self._server = server
        self._arrived: deque[bytes] = deque()
        """Bytes that the mesh has not read yet; b"" is the end."""

    def take(self) -> bytes | None:
        try:
            data = self.sock.recv(MAX_PACKET)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._close()
        return data or None

    def give(self, data: bytes) -> None:
        self._server.arrived()
        self._arrived.append(data)
        self.hand_over()

    def lost(self) -> None:
        self._arrived.append(b"")
        self.hand_over()

    def hand_over(self) -> None:
        """Write what has arrived, as far as the mesh's socket takes it."""
        while self._arrived:
            try:
                if data := self._arrived[0]:
                    self.sock.send(data)
                else:
                    self._close()
            except BlockingIOError:
                break
            except OSError:
                pass  # the mesh has closed it, which `take` will see
            self._arrived.popleft()
        self.full = bool(self._arrived)

    def _close(self) -> None:
        self.sock.close()
        self._server.ends.discard(self)


class RadioServer:
    """The radio and its sockets. Time passes only in `turn`."""

    def __init__(
        self, run_dir: Path, meshes: Mapping[str, Path], parameters: SlotParameters, seed: object, now: float
    ) -> None:
        """`meshes`: the socket of each robot's mesh, by name."""
        self._paths = meshes
        self._time = EventQueue()
        self._zero = now
        """The time of the real clock at which the radio's clock began."""
        self._connections = RadioConnections(self._time, meshes, parameters, seed)
        self.ends: set[SocketEnd] = set()
        """The ends with an open socket."""
        self._meshes: dict[str, socket.socket] = {}
        """A connection to the mesh of each robot that can be called."""
        self._asking: set[socket.socket] = set()
        """Connections without a request yet."""
        self._calls = 0
        self._now = 0.0
        self._frames = 0
        self._late = self._most_late = self.stood_still = 0.0
        self._path = socket_path(run_dir, RADIO_SOCKET)
        self._listener = bound(self._path, socket.SOCK_SEQPACKET)
        self._listener.listen(len(meshes))
        self._listener.setblocking(False)
        for ends, until in cuts_in(run_dir).items():  # of the later ones the listener hears
            a, b = ends
            if until > now and self._known(a, b):
                self._connections.cut(a, b, until - now)
        self._look()

    def watched(self) -> tuple[list[socket.socket], list[socket.socket]]:
        """Return the sockets to be waited for until they are readable, and writable."""
        ends = [end.sock for end in self.ends if self._connections.wants(end)]
        return (
            [self._listener, *self._meshes.values(), *self._asking, *ends],
            [end.sock for end in self.ends if end.full],
        )

    def turn(self, now: float, readable: Sequence[socket.socket] = (), writable: Sequence[socket.socket] = ()) -> float:
        """Let time pass to `now` on the real clock, then take what the meshes want. Return by when to call again."""
        if (late := now - self._zero - self._time.next_time) > MOST_LATE:
            self._zero += late - MOST_LATE
            self.stood_still += late - MOST_LATE
            _log.warning("the radio got no CPU time for %.1f s", late)
        self._now = now - self._zero
        self._time.run(self._now)
        if readable or writable:
            self._take(set(readable))
            for end in [end for end in self.ends if end.sock in writable]:
                end.hand_over()
                self._connections.flush(end.other)
            for end in [end for end in self.ends if end.sock in readable]:
                self._connections.flush(end)
            self._time.run(self._now)
        return self._zero + self._time.next_time + ROUNDING

    def arrived(self) -> None:
        """Note how late a frame is."""
        late = self._now - self._time.now
        self._frames += 1
        self._late += late
        self._most_late = max(self._most_late, late)

    def lateness(self) -> dict[str, float]:
        """Return how many frames have arrived, and how late the machine was with them, in s."""
        mean = self._late / self._frames if self._frames else 0.0
        return {
            "frames": self._frames,
            "late_mean_s": round(mean, 6),
            "late_most_s": round(self._most_late, 6),
            "stood_still_s": round(self.stood_still, 3),
        }

    def close(self) -> None:
        """Close all sockets, as when the process ends."""
        sockets = [self._listener, *self._meshes.values(), *self._asking, *(end.sock for end in self.ends)]
        for each in sockets:
            each.close()
        self._path.unlink(missing_ok=True)

    # -- requests ----------------------------------------------------------------------------------------------

    def _take(self, ready: set[socket.socket]) -> None:
        for robot, sock in [(robot, sock) for robot, sock in self._meshes.items() if sock in ready]:
            sock.close()  # nothing is ever written there: the mesh has ended
            del self._meshes[robot]
            self._connections.reachable.discard(robot)
        for sock in self._asking & ready:
            self._asking.discard(sock)
            self._answer(sock)
        if self._listener in ready:
            with contextlib.suppress(OSError):
                sock, _ = self._listener.accept()
                sock.setblocking(False)
                self._asking.add(sock)

    def _answer(self, sock: socket.socket) -> None:
        request = None
        with contextlib.suppress(OSError):
            request = decode_any(_KINDS, sock.recv(MAX_PACKET), RADIO_SOCKET)
        if isinstance(request, RadioCall) and self._known(request.caller, request.called):
            self._connections.call(request.caller, request.called, partial(self._called, sock, request))
            return
        if isinstance(request, RadioSupervise):
            for end in self.ends:
                if end.robot == request.robot and end.other.robot == request.peer:
                    self._connections.supervise(end, request.seconds)
        elif isinstance(request, RadioCut) and self._known(request.a, request.b):
            self._connections.cut(request.a, request.b, request.seconds)
        elif request is not None:
            _log.warning("refused: %s", request)
        sock.close()

    def _known(self, a: str, b: str) -> bool:
        return a != b and a in self._paths and b in self._paths

    def _called(self, sock: socket.socket, call: RadioCall, link: RadioLink | None, reason: str) -> None:
        """Tell both meshes that a call has ended."""
        there = None
        if link is not None and (there := self._connect(call.called, call.caller)) is None:
            self._connections.radio.drop(link)
            reason = "nobody listens there"
        with contextlib.suppress(OSError):  # the caller has ended, which `SocketEnd.take` will see
            sock.send(encode(RadioAnswer(reason)))
        if link is None or there is None:
            sock.close()
            return
        near, far = SocketEnd(call.caller, link, sock, self), SocketEnd(call.called, link, there, self)
        self._connections.join(near, far)
        self.ends |= {near, far}

    # -- the meshes --------------------------------------------------------------------------------------------

    def _look(self) -> None:
        """Find the meshes that have begun."""
        for robot in self._paths:
            if robot not in self._meshes and (sock := self._connect(robot, "")) is not None:
                self._meshes[robot] = sock
                self._connections.reachable.add(robot)
        self._time.at(self._time.now + LOOK_EVERY, self._look)

    def _connect(self, robot: str, caller: str) -> socket.socket | None:
        """Connect to a robot's mesh as a caller, "": as the radio itself. Return None where the mesh is not there."""
        self._calls += 1
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        sock.setblocking(False)
        try:
            sock.bind(call_from(self._calls, caller))
            sock.connect(os.fspath(self._paths[robot]))
        except OSError:
            sock.close()
            return None
        return sock


def main() -> None:
    """Run the radio until SIGTERM; then write how late it was."""
    die_with_parent()
    log.setup("radio")
    reader = argparse.ArgumentParser(prog="sim.processes.radio")
    reader.add_argument("parameters", type=SlotParameters.parse)
    reader.add_argument("seed", type=int)
    read = reader.parse_args()
    own = runtime_dir()
    ends = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ends.set())
    precise_timers()
    addresses = {robot.name: link_address.of_robot(robot) for robot in load().robots}
    meshes = {name: address.path for name, address in addresses.items() if isinstance(address, link_address.Slots)}
    server = RadioServer(own.parent, meshes, read.parameters, read.seed, clock.now())
    deadline = server.turn(clock.now())
    while not ends.is_set():
        readable, writable, _ = select.select(*server.watched(), [], max(0.0, deadline - clock.now()))
        deadline = server.turn(clock.now(), readable, writable)
    server.close()
    (own / LATENESS).write_text(json.dumps(server.lateness()))


if __name__ == "__main__":
    run(main)
