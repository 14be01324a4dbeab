"""The air of `--radio slots`: `sim.virtual.radio.air` over the slots of a Bluetooth radio (`sim.slots`)."""

from services.mesh.core.link.calls import Caller
from services.mesh.core.link.session import Session
from services.mesh.mesh import CLOSED
from sim.slots.connections import CHUNK, End, RadioConnections
from sim.slots.devices import RadioLink
from sim.slots.parameters import SlotParameters
from sim.virtual.events import EventQueue
from sim.virtual.radio.air import Station


class SlotEnd(End):
    """One end of a connection; see `sim.virtual.radio.air.Medium`."""

    def __init__(self, station: Station, link: RadioLink) -> None:
        super().__init__(station.robot, link)
        self.station = station
        self.session: Session | None = None

    def take(self) -> bytes | None:
        if self.session is None:
            return b""
        data = self.session.data_to_send(self.station.time.now, CHUNK)
        if not data:
            self.station.flushed(self.session)
        return data

    def give(self, data: bytes) -> None:
        if self.session is not None:
            self.station.received([(self.session, data or CLOSED)])

    def lost(self) -> None:
        if self.session is not None:
            self.station.received([(self.session, "silent: the radio gave the link up")])


class SlotAir(RadioConnections):
    """All links of a swarm; see `sim.virtual.radio.air.Medium`."""

    def __init__(self, time: EventQueue, names: tuple[str, ...], parameters: SlotParameters, seed: object) -> None:
        super().__init__(time, names, parameters, seed)
        self._stations: dict[str, Station] = {}

    def add(self, station: Station) -> None:
        """Add a robot that can be dialled."""
        self._stations[station.robot] = station
        self.reachable.add(station.robot)

    def remove(self, station: Station) -> None:
        """Remove a robot; it can no longer be dialled."""
        del self._stations[station.robot]
        self.reachable.discard(station.robot)

    def dial(self, caller: Station, peer: str) -> None:
        """Make a connection, and tell both ends of it; or tell the caller that there is none."""
        self.call(caller.robot, peer, lambda link, reason: self._dialled(caller, peer, link, reason))

    def _dialled(self, caller: Station, peer: str, link: RadioLink | None, reason: str) -> None:
        called = self._stations.get(peer)
        if link is None or called is None or not caller.running:
            if link is not None:
                self.radio.drop(link)
            if caller.running:
                caller.dial_failed(peer, reason or "nobody listens there")
            return
        near, far = SlotEnd(caller, link), SlotEnd(called, link)
        self.join(near, far)
        caller.dialled(peer, near)
        called.accepted(far, Caller(caller.robot, caller.robot))
