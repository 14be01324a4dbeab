"""`--mesh delay`: the delays of a mesh in place of the mesh itself, for swarms too large for whole meshes.

A message to neighbours takes the time that its frame takes on the link (the same model, the same generators), and
nothing else: no handshake, no heartbeats, no link state, no queues of other traffic. The relay rules hold. Floods,
messages to single robots and the mesh clock are the business of a mesh, and are not there.

All that arrives at a robot in one moment is handed over at once, as from a mesh: the robot's objects are looked up in
memory once for all, and its lockstep is asked once what is to be done. What one robot does in a moment reaches another
one a link's latency later at the earliest, so it makes no difference in which order robots have a moment in common.
"""

from collections.abc import Mapping, Sequence
from functools import partial

from services.mesh.core.relay import KeyRelay
from services.mesh.core.wire.frames import NEIGHBOURS
from services.mesh.links.radio_model import AirModel, DelayLine
from services.mesh.mesh import REPORT_PERIOD
from sim.virtual.bus import VirtualBus
from sim.virtual.events import EventQueue
from sim.virtual.periodic_publisher import PeriodicPublisher
from sim.virtual.radio.air import line_of
from swarm.bus.protocol import OnSample
from swarm.config import Config
from swarm.errors import LocalError
from swarm.messages import Links, LinkState
from swarm.messages.keys import key

OVERHEAD = 5
"""Bytes of a DATA frame before its payload, of a channel that is bound already."""

Message = tuple[tuple[OnSample, ...], str, bytes]
"""The receiver's callbacks, the key and the payload of a message."""


class DelayMesh:
    """A mesh that carries one robot's messages to its neighbours with delays alone."""

    def __init__(
        self, config: Config, robot: str, peers: tuple[str, ...], model: AirModel, time: EventQueue, bus: VirtualBus
    ) -> None:
        self.robot = robot
        self._time = time
        self._bus = bus
        self._relay = KeyRelay(robot, peers, config.relay, (robot, *peers))
        self._lines: dict[str, DelayLine] = {peer: line_of(model, robot, peer) for peer in peers}
        self._meshes: Mapping[str, DelayMesh] = {}
        self._cuts: Mapping[frozenset[str], float] = {}
        self._due: dict[float, list[Message]] = {}
        """The messages on their way to this robot, by time of arrival."""
        self._sent = dict.fromkeys(peers, 0)
        self._links_key = key(robot, "mesh", "links")
        PeriodicPublisher(time, bus, (self._links_key,), REPORT_PERIOD, time.now, self._tell_links)
        for source, expression in enumerate(self._relay.subscriptions):
            bus.subscribe(expression, partial(self._publish, source))
        bus.subscribe([key(robot, "mesh", "set", "*"), key(robot, "mesh", "set", "*", "**")], self._refuse)

    @property
    def sent(self) -> int:
        """Messages, counted once for each neighbour."""
        return sum(self._sent.values())

    def link(self, meshes: Mapping[str, "DelayMesh"], cuts: Mapping[frozenset[str], float]) -> None:
        """Link with all robots' meshes, once they are there; `cuts`: until when nothing passes between two robots."""
        self._meshes, self._cuts = meshes, cuts

    def _publish(self, source: int, name: str, payload: bytes) -> None:
        now = self._time.now
        for leg, data in self._relay.publish(source, name, payload, now):
            if leg.avoid_link:
                continue  # the business of a mesh, too, but nobody has asked for it by name
            if leg.overlay != NEIGHBOURS:
                self._refuse(name, payload)
            size = OVERHEAD + len(data)
            for peer in leg.peers:
                self._sent[peer] += 1
                line = self._lines[peer]
                arrival = line.arrival(size, now)
                if self._cuts:
                    arrival = line.hold(max(arrival, self._cuts.get(frozenset((self.robot, peer)), 0.0)))
                self._meshes[peer].expect(arrival, name, data, alone=bool(self._cuts))

    def expect(self, arrival: float, name: str, data: bytes, *, alone: bool) -> None:
        """Take a message for the subscribers that hear it now, not for an app that begins meanwhile. `alone`: it is
        not handed over with others. Behind a cut several of one link arrive in one moment, in turn."""
        message = self._bus.hearers(name), name, data
        if alone:
            self._time.at(arrival, self._hand_over, (message,))
            return
        messages = self._due.get(arrival)
        if messages is None:
            self._due[arrival] = [message]
            self._time.at(arrival, self._arrive, arrival)
        else:
            messages.append(message)

    def _arrive(self, arrival: float) -> None:
        self._hand_over(self._due.pop(arrival))

    def _hand_over(self, messages: Sequence[Message]) -> None:
        for heard, name, data in messages:
            for callback in heard:
                callback(name, data)

    def _tell_links(self) -> None:
        """Publish the links: those that are not cut are up. Messages on their way count as received."""
        now, links = self._time.now, []
        for peer, sent in self._sent.items():
            up = self._cuts.get(frozenset((self.robot, peer)), 0.0) <= now
            received = self._meshes[peer]._sent[self.robot]
            links.append(LinkState(peer, "up" if up else "down", 1, None, sent, received, "" if up else "it is cut"))
        self._bus.publish(self._links_key, Links(now, tuple(links)))

    def _refuse(self, name: str, payload: bytes) -> None:
        raise LocalError(
            f"{name}: --mesh delay carries messages to neighbours alone; say --mesh settled for an app that floods, "
            "sends or asks its mesh for something"
        )
