"""Links under virtual time: byte pipes with latency, jitter, bandwidth and cuts, as `services.mesh.links.sim` makes
them of Unix sockets, with the same delays from the same generators."""

import random
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

from services.mesh.core.link.calls import UNKNOWN, Caller
from services.mesh.core.link.flow import FRAGMENT
from services.mesh.core.link.session import Session
from services.mesh.links.radio_model import AirModel, DelayLine
from services.mesh.mesh import CLOSED, Mesh
from sim.slots.connections import CHUNK, SOCKET
from sim.virtual.events import EventQueue, Time
from swarm.process.runtime import Timer

UNREACHABLE = "unreachable"


Due = dict[float, list["ConnectionEnd"]]
"""Chunks on the way to a robot: for each moment of arrival the ends to which they come, one for each chunk."""


class Medium(Protocol):
    """The medium that carries the links of a swarm. Its ends have a `session`; stations hand them back."""

    cuts: dict[frozenset[str], float]
    """The time until which nothing passes between two robots."""

    def add(self, station: "Station") -> None:
        """Add a robot that can be dialled."""

    def remove(self, station: "Station") -> None:
        """Remove a robot; it can no longer be dialled."""

    def cut(self, a: str, b: str, seconds: float) -> None:
        """Let nothing pass between two robots for a while; what is under way arrives afterwards."""

    def switch_off(self, robot: str) -> None:
        """Let a robot that is about to end lose its power: a radio carries its last words no more."""

    def dial(self, caller: "Station", peer: str) -> None:
        """Make a connection, and tell both ends of it; or tell the caller that there is none."""

    def flush(self, end: Any) -> None:
        """Put what the session of an end has to send on the air, as far as it takes it."""

    def close(self, end: Any) -> None:
        """Close an end: the other one hears of it as of everything else."""

    def supervise(self, end: Any, seconds: float) -> None:
        """See `services.mesh.surroundings.Transport`."""


class ConnectionEnd:
    """One end of a connection, and the ways from and to it: who sends has no need to look at the other end, nor who
    receives. In a large swarm each look is one into memory that no cache holds."""

    def __init__(self, station: "Station", line: DelayLine, inward: DelayLine, due: Due) -> None:
        self.station = station
        self.line = line
        """The air from here to the other end."""
        self.inward = inward
        """The air from there to this one."""
        self.due = due
        """The chunks on their way to the robot at the other end."""
        self.other: ConnectionEnd = self
        self.session: Session | None = None
        self.alive = True
        """Whether the end is open: False once it has closed, or has noticed that the other end has."""
        self.socket: deque[bytes] = deque()
        """Writes that wait for the air."""
        self.waits = False
        """Whether the air's next free moment is planned."""


class Station:
    """The connections of one robot's mesh; see `services.mesh.surroundings.Transport`."""

    def __init__(self, robot: str, time: Time, air: Medium) -> None:
        self.robot = robot
        self.time = time
        """The robot's clock."""
        self._air = air
        self._mesh: Mesh
        self._ends: dict[Session, Any] = {}
        """The medium's ends of connections."""
        self.wake: Callable[[float], None]
        """Function that calls the mesh at a time, s, or earlier: a call that is planned already stays."""

    def start(self, mesh: Mesh) -> None:
        """Let the robot be dialled."""
        self._mesh = mesh
        self.wake = Timer(self.time.at, mesh.due).plan
        self._air.add(self)

    def end(self) -> None:
        """Close all connections, without a word, and let the mesh do nothing any more."""
        self._mesh.running = False
        self._air.remove(self)
        for end in self._ends.values():
            self._air.close(end)
        self._ends.clear()

    # -- what the mesh calls -----------------------------------------------------------------------------------

    def dial(self, peer: str) -> None:
        self._air.dial(self, peer)

    def flush(self, session: Session) -> None:
        """Send what the session has to send."""
        if (end := self._ends.get(session)) is not None:
            self._air.flush(end)

    def close(self, session: Session) -> None:
        """Send what the session still has, and close its connection."""
        if (end := self._ends.pop(session, None)) is not None:
            self._air.flush(end)
            self._air.close(end)

    def supervise(self, session: Session, seconds: float) -> None:
        """Be the central of a connection, and let go of it when it has been silent for that long."""
        if (end := self._ends.get(session)) is not None:
            self._air.supervise(end, seconds)

    # -- what the air calls ------------------------------------------------------------------------------------

    def flushed(self, session: Session) -> None:
        """Note that a session has given all that leaves now."""
        self._mesh.flushed(session, self.time.now)

    @property
    def running(self) -> bool:
        """Return whether the mesh runs: False after its end."""
        return self._mesh.running

    def dialled(self, peer: str, end: Any) -> None:
        """Take the connection that was asked for."""
        end.session = self._mesh.dialled(peer)
        self._ends[end.session] = end
        self._mesh.carry_out()

    def accepted(self, end: Any, caller: Caller = UNKNOWN) -> None:
        """Take a call of another robot."""
        end.session = self._mesh.accepted(caller)
        if end.session is None:
            self._air.close(end)
        else:
            self._ends[end.session] = end
        self._mesh.carry_out()

    def dial_failed(self, peer: str, reason: str) -> None:
        """Note that the connection that was asked for could not be made."""
        self._mesh.dial_failed(peer, reason)

    def received(self, arrivals: list[tuple[Session, bytes | str]]) -> None:
        """Take the arrivals of this moment; see `Mesh.received`."""
        self._mesh.received(arrivals)


class Air:
    """All links of a swarm, each with the same delays; see `Medium`."""

    def __init__(self, time: EventQueue, model: AirModel) -> None:
        self._time = time
        self._model = model
        self._stations: dict[str, Station] = {}
        self._due: dict[str, Due] = {}
        self.cuts: dict[frozenset[str], float] = {}
        """The time until which nothing passes between two robots."""

    def add(self, station: Station) -> None:
        """Add a robot that can be dialled."""
        self._stations[station.robot] = station
        self._due[station.robot] = {}

    def remove(self, station: Station) -> None:
        """Remove a robot; it can no longer be dialled."""
        del self._stations[station.robot]

    def cut(self, a: str, b: str, seconds: float) -> None:
        """Let nothing pass between two robots for a while; what is under way arrives afterwards."""
        pair = frozenset((a, b))
        self.cuts[pair] = max(self.cuts.get(pair, 0.0), self._time.now + seconds)

    def switch_off(self, robot: str) -> None:
        """Do nothing: the other end of a pipe hears of its end whatever has ended it."""

    def dial(self, caller: Station, peer: str) -> None:
        """Make a connection, and tell both ends of it; or tell the caller that there is none."""
        self._time.at(self._time.now + self._model.dial, self._dialled, caller, peer)

    def flush(self, end: ConnectionEnd) -> None:
        """Put what the session of an end has to send on the air, as far as it takes it."""
        session, now = end.session, self._time.now
        if session is None or not end.alive:
            return
        if self._model.bandwidth is None:
            while data := session.data_to_send(end.station.time.now, CHUNK):
                self._plan(end, end.line.push(data, now))
                if len(data) < FRAGMENT and not session.queue.bulk_waits:
                    break  # nothing more may leave now, which a second question would only confirm
        else:
            while sum(map(len, end.socket)) < SOCKET and (data := session.data_to_send(end.station.time.now, CHUNK)):
                end.socket.append(data)
            self._send(end)
        end.station.flushed(session)

    def close(self, end: ConnectionEnd) -> None:
        """Close an end: the other one hears of it as of everything else."""
        if not end.alive:
            return
        end.alive = False
        while end.socket:
            self._push(end, end.socket.popleft())
        self._push(end, b"")

    def supervise(self, end: ConnectionEnd, seconds: float) -> None:
        """Do nothing: a pipe has no supervision."""

    def _dialled(self, caller: Station, peer: str) -> None:
        if not caller.running:
            return
        called = self._stations.get(peer)
        if called is None or self._cut_until(caller.robot, peer) > self._time.now:
            caller.dial_failed(peer, UNREACHABLE)
            return
        there, back = self._line(caller.robot, peer), self._line(peer, caller.robot)
        near = ConnectionEnd(caller, there, back, self._due[peer])
        far = ConnectionEnd(called, back, there, self._due[caller.robot])
        near.other, far.other = far, near
        caller.dialled(peer, near)
        called.accepted(far)

    def _line(self, sender: str, receiver: str) -> DelayLine:
        return line_of(self._model, sender, receiver)

    def _send(self, end: ConnectionEnd) -> None:
        """Move writes from the socket onto the air at its own pace."""
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
        """Plan the arrival of what `sender` has sent. A robot gets all arrivals of one moment at once, so its
        objects are looked up in memory once for all."""
        due, receiver = sender.due, sender.other
        receivers = due.get(at)
        if receivers is None:
            due[at] = [receiver]
            self._time.at(at, self._arrive, receiver.station, due, at)
        else:
            receivers.append(receiver)

    def _cut_until(self, a: str, b: str) -> float:
        return self.cuts.get(frozenset((a, b)), 0.0) if self.cuts else 0.0

    def _arrive(self, station: Station, due: Due, at: float) -> None:
        """Let the oldest chunk on the way to each of the ends arrive."""
        arrivals: list[tuple[Session, bytes | str]] = []
        for receiver in due.pop(at):
            if self.cuts:
                until = self._cut_until(receiver.other.station.robot, station.robot)
                if until > self._time.now:
                    # Whichever call comes first then takes the oldest chunk, so the order stays.
                    self._plan(receiver.other, until)
                    continue
            data = receiver.inward.pop()
            if receiver.alive:
                receiver.alive = bool(data)
                if receiver.session is not None:
                    arrivals.append((receiver.session, data or CLOSED))
        if arrivals:
            station.received(arrivals)


def line_of(model: AirModel, sender: str, receiver: str) -> DelayLine:
    """Return the way from one robot to another; both names and the seed decide its randomness."""
    if not model.draws:
        return DelayLine(model, None)  # a generator takes 2.5 kB, and there may be many links
    return DelayLine(model, random.Random(f"{model.seed}:{sender}>{receiver}"))
