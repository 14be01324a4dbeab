"""`--mesh delay`: in the place of a robot's mesh the delay that it has, for swarms too large for whole meshes.

A message to neighbours takes the time that its frame takes on the link (the same model, the same generators), and
nothing else: no handshake, no heartbeats, no link state, no queues of other traffic. The relay rules hold. Floods,
messages to single robots and the mesh clock are the business of a mesh, and are not there.
"""

from collections.abc import Mapping
from functools import partial

from services.mesh.core.delay import AirModel, DelayLine
from services.mesh.core.frames import NEIGHBOURS
from services.mesh.core.relay import Relay
from services.sim.virtual.air import line_of
from services.sim.virtual.bus import OnSample, VirtualBus
from services.sim.virtual.events import EventQueue
from swarm.config import Config
from swarm.errors import LocalError
from swarm.keys import key

OVERHEAD = 5
"""Bytes of a DATA frame before its payload, of a channel that is bound already."""


class DelayMesh:
    """What carries one robot's messages to its neighbours."""

    def __init__(
        self, config: Config, robot: str, peers: tuple[str, ...], model: AirModel, time: EventQueue, bus: VirtualBus
    ) -> None:
        self.robot = robot
        self.sent = 0
        """Messages, counted once for each neighbour."""
        self.buses: Mapping[str, VirtualBus] = {}
        """Where the neighbours' messages appear, by robot; set once all are there."""
        self.cuts: Mapping[frozenset[str], float] = {}
        """Until when nothing passes between two robots."""
        self._time = time
        self._relay = Relay(robot, peers, config.relay, (robot, *peers))
        self._lines: dict[str, DelayLine] = {peer: line_of(model, robot, peer) for peer in peers}
        self._heard: dict[tuple[str, str], tuple[OnSample, ...]] = {}
        for source, expression in enumerate(self._relay.subscriptions):
            bus.subscribe(expression, partial(self._publish, source))
        bus.subscribe([key(robot, "mesh", "set", "*"), key(robot, "mesh", "set", "*", "**")], self._refuse)

    def renewed(self, peer: str) -> None:
        """A neighbour's hosts are others now."""
        self._heard = {at: heard for at, heard in self._heard.items() if at[0] != peer}

    def _publish(self, source: int, name: str, payload: bytes) -> None:
        now = self._time.now
        for leg, data in self._relay.publish(source, name, payload, now):
            if leg.overlay != NEIGHBOURS:
                self._refuse(name, payload)
            for peer in leg.peers:
                self.sent += 1
                line = self._lines[peer]
                arrival = line.arrival(OVERHEAD + len(data), now)
                if self.cuts:
                    arrival = line.hold(max(arrival, self.cuts.get(frozenset((self.robot, peer)), 0.0)))
                heard = self._heard.get((peer, name))
                if heard is None:
                    heard = self._heard[peer, name] = self.buses[peer].hearers(name)
                for callback in heard:
                    self._time.at(arrival, callback, name, data)

    def _refuse(self, name: str, payload: bytes) -> None:
        raise LocalError(
            f"{name}: --mesh delay carries messages to neighbours alone; leave it out for an app that floods, sends or "
            "asks its mesh for something"
        )
