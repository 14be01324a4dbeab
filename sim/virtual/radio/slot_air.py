"""The air of `--radio slots`: `sim.virtual.radio.air` over the slots of a Bluetooth radio (`sim.slots`)."""

from services.mesh.core.link.calls import Caller
from services.mesh.core.link.session import Session
from services.mesh.links.rfcomm import DIAL_TIMEOUT
from services.mesh.mesh import CLOSED
from sim.slots.calls import Calls
from sim.slots.parameters import FRAME, Parameters
from sim.slots.radio import RadioLink, SlotRadio
from sim.virtual.events import EventQueue
from sim.virtual.radio.air import CHUNK, SOCKET, Station
from swarm.bluetooth.hci import SUPERVISION_SHARE


class SlotEnd:
    """One end of a connection."""

    def __init__(self, station: Station, link: RadioLink) -> None:
        self.station = station
        self.link = link
        self.other: SlotEnd = self
        self.session: Session | None = None
        self.alive = True
        """False once this end has closed, or has noticed that the other one has."""
        self.backlog = 0
        """Bytes that have not reached the other end."""


class SlotAir:
    """All links of a swarm; see `sim.virtual.radio.air.Medium`."""

    def __init__(self, time: EventQueue, names: tuple[str, ...], parameters: Parameters, seed: object) -> None:
        self._time = time
        self.radio = SlotRadio(time, names, parameters, seed)
        self.radio.passes = self._passes
        self._calls = Calls(time, self.radio)
        self._stations: dict[str, Station] = {}
        self.cuts: dict[frozenset[str], float] = {}
        """Until when nothing passes between two robots."""

    def add(self, station: Station) -> None:
        """Add a robot that can be dialled."""
        self._stations[station.robot] = station
        self._calls.reachable.add(station.robot)

    def remove(self, station: Station) -> None:
        """It can no more."""
        del self._stations[station.robot]
        self._calls.reachable.discard(station.robot)

    def cut(self, a: str, b: str, seconds: float) -> None:
        """Let nothing pass between two robots for a while."""
        pair = frozenset((a, b))
        self.cuts[pair] = max(self.cuts.get(pair, 0.0), self._time.now + seconds)

    def dial(self, caller: Station, peer: str) -> None:
        """Make a connection, and tell both ends of it; or tell the caller that there is none."""
        self._calls.call(
            caller.robot, peer, DIAL_TIMEOUT, lambda link, reason: self._dialled(caller, peer, link, reason)
        )

    def flush(self, end: SlotEnd) -> None:
        """Hand what the session of an end has to send to the radio, as far as its socket takes it."""
        session = end.session
        if session is None or not end.alive:
            return
        while end.backlog < SOCKET and (data := session.data_to_send(end.station.time.now, CHUNK)):
            for at in range(0, len(data), FRAME):
                self._send(end, data[at : at + FRAME])

    def close(self, end: SlotEnd) -> None:
        """Close an end: the other one hears of it after what was sent before, or when the radio gives the link up."""
        if end.alive:
            end.alive = False
            if end.other.alive:
                self._send(end, b"")
            else:
                self.radio.drop(end.link)

    def supervise(self, end: SlotEnd, seconds: float) -> None:
        """Have the radio give the connection up after somewhat less silence."""
        self.radio.supervise(end.link, SUPERVISION_SHARE * seconds)

    def _passes(self, a: str, b: str) -> bool:
        return not self.cuts or self.cuts.get(frozenset((a, b)), 0.0) <= self._time.now

    def _dialled(self, caller: Station, peer: str, link: RadioLink | None, reason: str) -> None:
        called = self._stations.get(peer)
        if link is None or called is None or not caller.running:
            if link is not None:
                self.radio.drop(link)
            if caller.running:
                caller.dial_failed(peer, reason or "nobody listens there")
            return
        near, far = SlotEnd(caller, link), SlotEnd(called, link)
        near.other, far.other = far, near
        link.lost = lambda: self._lost(near, far)
        caller.dialled(peer, near)
        called.accepted(far, Caller(caller.robot, caller.robot))

    def _lost(self, *ends: SlotEnd) -> None:
        for end in ends:
            if end.alive:
                end.alive = False
                if end.session is not None:
                    end.station.received([(end.session, "silent: the radio gave the link up")])

    def _send(self, end: SlotEnd, data: bytes) -> None:
        end.backlog += len(data)
        self.radio.send(end.link, end.station.robot, len(data), lambda: self._arrived(end, data))

    def _arrived(self, sender: SlotEnd, data: bytes) -> None:
        receiver = sender.other
        sender.backlog -= len(data)
        if receiver.alive:
            receiver.alive = bool(data)
            if receiver.session is not None:
                receiver.station.received([(receiver.session, data or CLOSED)])
        if not receiver.alive and not sender.alive:
            self.radio.drop(sender.link)
        else:
            self.flush(sender)
