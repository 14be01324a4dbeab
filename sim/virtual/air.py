"""Links under virtual time: byte pipes with latency, jitter, bandwidth and cuts, as `services.mesh.links.sim` makes
them of Unix sockets, with the same delays from the same generators."""

import random
from collections import deque
from typing import TYPE_CHECKING

from services.mesh.core.link.session import Session
from services.mesh.core.radio_model import AirModel, DelayLine
from sim.virtual.events import EventQueue

if TYPE_CHECKING:
    from sim.virtual.mesh import VirtualMesh

CHUNK = 4096
"""Bytes taken from a session at a time, as `services.mesh.runner` does."""
SOCKET = 50_000
"""Bytes that the sender's socket takes, as `services.mesh.links.sim.SEND_BUFFER` has it."""

UNREACHABLE = "unreachable"


Due = dict[float, list["ConnectionEnd"]]
"""What is on the way to a robot: for each moment at which something arrives the ends it comes to, one a chunk."""


class ConnectionEnd:
    """One end of a connection, and the ways from and to it: who sends has no need to look at the other end, nor who
    receives. In a large swarm each look is one into memory that no cache holds."""

    __slots__ = ("alive", "due", "inward", "line", "mesh", "other", "session", "socket", "waits")

    def __init__(self, mesh: "VirtualMesh", line: DelayLine, inward: DelayLine, due: Due) -> None:
        self.mesh = mesh
        self.line = line
        """The air from here to the other end."""
        self.inward = inward
        """The air from there to this one."""
        self.due = due
        """What is on the way to the robot at the other end."""
        self.other: ConnectionEnd = self
        self.session: Session | None = None
        self.alive = True
        """False once this end has closed, or has noticed that the other one has."""
        self.socket: deque[bytes] = deque()
        """Writes that wait for the air."""
        self.waits = False
        """Whether the air's next free moment is planned."""


class Air:
    """All links of a swarm."""

    def __init__(self, time: EventQueue, model: AirModel) -> None:
        self._time = time
        self._model = model
        self._meshes: dict[str, VirtualMesh] = {}
        self._due: dict[str, Due] = {}
        self.cuts: dict[frozenset[str], float] = {}
        """Until when nothing passes between two robots."""

    def add(self, mesh: "VirtualMesh") -> None:
        """A robot that can be dialled."""
        self._meshes[mesh.robot] = mesh
        self._due[mesh.robot] = {}

    def remove(self, mesh: "VirtualMesh") -> None:
        """It can no more."""
        del self._meshes[mesh.robot]

    def cut(self, a: str, b: str, seconds: float) -> None:
        """Nothing passes between two robots for a while; what is under way arrives afterwards."""
        pair = frozenset((a, b))
        self.cuts[pair] = max(self.cuts.get(pair, 0.0), self._time.now + seconds)

    def dial(self, caller: "VirtualMesh", peer: str) -> None:
        """Make a connection, and tell both ends of it; or tell the caller that there is none."""
        self._time.at(self._time.now + self._model.dial, self._dialled, caller, peer)

    def flush(self, end: ConnectionEnd) -> None:
        """Put what the session of an end has to send on the air, as far as it takes it."""
        session, now = end.session, self._time.now
        if session is None or not end.alive:
            return
        if self._model.bandwidth is None:
            while data := session.data_to_send(end.mesh.now, CHUNK):
                self._plan(end, end.line.push(data, now))
            return
        while sum(map(len, end.socket)) < SOCKET and (data := session.data_to_send(end.mesh.now, CHUNK)):
            end.socket.append(data)
        self._send(end)

    def close(self, end: ConnectionEnd) -> None:
        """Close an end: the other one hears of it as of everything else."""
        if not end.alive:
            return
        end.alive = False
        while end.socket:
            self._push(end, end.socket.popleft())
        self._push(end, b"")

    def _dialled(self, caller: "VirtualMesh", peer: str) -> None:
        if not caller.running:
            return
        mesh = self._meshes.get(peer)
        if mesh is None or self._cut_until(caller.robot, peer) > self._time.now:
            caller.dial_failed(peer, UNREACHABLE)
            return
        there, back = self._line(caller.robot, peer), self._line(peer, caller.robot)
        near = ConnectionEnd(caller, there, back, self._due[peer])
        far = ConnectionEnd(mesh, back, there, self._due[caller.robot])
        near.other, far.other = far, near
        caller.dialled(peer, near)
        mesh.accepted(far)

    def _line(self, sender: str, receiver: str) -> DelayLine:
        return line_of(self._model, sender, receiver)

    def _send(self, end: ConnectionEnd) -> None:
        """From the socket onto the air at its own pace."""
        while end.socket and end.line.free_at <= self._time.now:
            self._push(end, end.socket.popleft())
        if end.socket and not end.waits:
            end.waits = True
            self._time.at(end.line.free_at, self._freed, end)

    def _freed(self, end: ConnectionEnd) -> None:
        end.waits = False
        self._send(end)
        self.flush(end)

    def _push(self, end: ConnectionEnd, data: bytes) -> None:
        self._plan(end, end.line.push(data, self._time.now))

    def _plan(self, sender: ConnectionEnd, at: float) -> None:
        """What arrives at a robot in one moment it gets at once: its objects are looked up in memory once for all."""
        due, receiver = sender.due, sender.other
        receivers = due.get(at)
        if receivers is None:
            due[at] = [receiver]
            self._time.at(at, self._arrive, receiver.mesh, due, at)
        else:
            receivers.append(receiver)

    def _cut_until(self, a: str, b: str) -> float:
        return self.cuts.get(frozenset((a, b)), 0.0) if self.cuts else 0.0

    def _arrive(self, mesh: "VirtualMesh", due: Due, at: float) -> None:
        """The oldest chunks on the way to each of the ends arrive."""
        chunks = []
        for receiver in due.pop(at):
            if self.cuts:
                until = self._cut_until(receiver.other.mesh.robot, mesh.robot)
                if until > self._time.now:
                    # Whichever call comes first then takes the oldest chunk, so the order stays.
                    self._plan(receiver.other, until)
                    continue
            data = receiver.inward.pop()
            if receiver.alive:
                receiver.alive = bool(data)
                chunks.append((receiver, data))
        if chunks:
            mesh.receive(chunks)


def line_of(model: AirModel, sender: str, receiver: str) -> DelayLine:
    """The way from one robot to another; both names and the seed decide its randomness."""
    if not model.draws:
        return DelayLine(model, None)  # a generator takes 2.5 kB, and there may be many links
    return DelayLine(model, random.Random(f"{model.seed}:{sender}>{receiver}"))
