"""The host of one app on one robot under virtual time: what `services.apps.host` is in a process."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from services.apps.core.strand import Strand
from services.apps.core.terms import Terms
from services.apps.host import TICK, schema_of
from services.apps.runner import Runner
from sim.virtual.bus import VirtualBus
from sim.virtual.events import Time
from sim.virtual.periodic_publisher import PeriodicPublisher
from sim.virtual.strand import Measurements, Told, VirtualStrand
from swarm.app.run_options import RunOptions
from swarm.core.epoch_actions import Order
from swarm.core.epoch_notes import Epoch, Kept
from swarm.core.graph import Graph
from swarm.core.lockstep import Channel
from swarm.core.lockstep_actions import address_of
from swarm.errors import FrameError
from swarm.messages import Links, SetAppEpoch, Topology
from swarm.messages.codec import decode
from swarm.messages.keys import key


class Place(NamedTuple):
    """Where a host runs, and in which run."""

    robot: str
    names: frozenset[str]
    """Of all robots."""
    begin: Epoch
    """Its members and links, the same object for all robots."""
    graph: Graph
    run: int
    run_options: RunOptions
    time: Time
    bus: VirtualBus
    incarnation: int = 1
    """Goes up with every start of the robot."""
    kept: Kept | None = None
    """What it has voted before the newest one."""

    @property
    def neighbours(self) -> tuple[str, ...]:
        """Of this robot, sorted."""
        return self.graph.neighbours(self.robot)

    @property
    def prefix(self) -> str:
        """What the tickets of this host's requests begin with: another one in each run."""
        return f"{self.run & 0xFFFFFFFFFFFF:012x}" + (f"-{self.incarnation}" if self.incarnation > 1 else "")


class VirtualHost:
    """The lockstep channels of one app on one robot."""

    __slots__ = (
        "_by_schema",
        "_connections",
        "_edges",
        "_notes",
        "_place",
        "_senders",
        "app",
        "robot",
        "strands",
    )

    def __init__(
        self,
        app: str,
        runners: Mapping[str, Runner],
        digest: bytes,
        place: Place,
        measurements: Measurements | None,
        told: Told,
        latest: Mapping[str, Callable[[int, bytes], None]] | None = None,
    ) -> None:
        """`runners` by channel, the name empty for an app that is one lockstep; `digest` of the app's source;
        `latest[channel](k, state)` is called with each packed state."""
        self.app = app
        self.robot = place.robot
        self.strands: dict[str, VirtualStrand] = {}
        self._place = place
        self._by_schema: dict[int, VirtualStrand] = {}
        self._notes: dict[str, VirtualStrand] = {}
        self._edges: tuple[tuple[str, ...], ...] = ()
        self._senders: dict[str, tuple[VirtualStrand, str, Channel | None, bool] | None] = {}
        self._connections: dict[str, int] = {}
        for part, runner in runners.items():
            schema = schema_of(runner, part, digest)
            how = place.run_options
            terms = Terms(place.run, schema, how.last, how.rule, how.drop, how.after)
            begin, graph = place.begin, place.graph
            strand = Strand(place.robot, place.names, terms, begin, graph, place.incarnation, runner, place.kept)
            self.strands[part] = self._by_schema[schema] = self._notes[terms.notes] = VirtualStrand(
                strand,
                runner,
                robot=place.robot,
                app=app,
                part=part,
                time=place.time,
                bus=place.bus,
                measurements=measurements,
                told=told,
                latest=(latest or {}).get(part),
            )
        place.bus.subscribe(key("*", f"app/{app}", "sync", "**"), self._on_sync)
        place.bus.subscribe(key(place.robot, "mesh", "links"), self._on_links)
        place.bus.subscribe(key(place.robot, f"app/{app}", "set", "epoch"), self._on_order)
        if place.run_options.drop:  # else nobody asks which links are in force
            place.bus.subscribe(key(place.robot, "mesh", "topology"), self._on_topology)

    def start(self) -> None:
        """Begin all channels."""
        for strand in self.strands.values():
            strand.start()
        time, keys = self._place.time, tuple(key for strand in self.strands.values() for key in strand.shown_keys)
        PeriodicPublisher(time, self._place.bus, keys, TICK, time.now + TICK, self._show)

    @property
    def kept(self) -> Kept | None:
        """What the robot keeps of the app through a reboot."""
        return self.strands[""].kept

    def close(self) -> None:
        """End as by kill -9."""
        self._place.bus.close()
        for strand in self.strands.values():
            strand.close()

    def _on_sync(self, name: str, payload: bytes) -> None:
        try:
            known = self._senders[name]
        except KeyError:
            known = self._senders[name] = self._parsed(name)
        if known is not None:
            strand, sender, channel, around = known
            if channel is not None:
                strand.receive(sender, channel, payload, around=around)
            elif sender != self.robot:
                strand.receive_note(sender, payload)

    def _parsed(self, name: str) -> tuple[VirtualStrand, str, Channel | None, bool] | None:
        """Whom a frame's key is for, sender and channel (None for a note about the members), whether it has come around
        a silent link; None where it is for another robot, or is no such key."""
        if (address := address_of(name)) is None:
            return None
        sender, _, text, to, around = address
        if to is not None and to != self.robot:
            return None
        if text in self._notes:
            return self._notes[text], sender, None, False
        try:
            channel = Channel.parse(text)
        except FrameError:
            return None
        strand = self._by_schema.get(channel.schema)
        return None if strand is None else (strand, sender, channel, around)

    def _on_links(self, name: str, payload: bytes) -> None:
        links = decode(Links, payload, name).links
        up = {link.peer: link.connection for link in links if link.state == "up"}
        # The median: after a cut the smoothed one is for seconds as long as the cut was.
        rtts = [link.rtt_median for link in links if link.rtt_median is not None]
        renewed = any(self._connections.get(peer) != connection for peer, connection in up.items())
        self._connections.update(up)
        for strand in self.strands.values():
            if rtts:
                strand.take_rtt(max(rtts))
            if renewed:
                strand.nudge()

    def _on_order(self, name: str, payload: bytes) -> None:
        wish = decode(SetAppEpoch, payload, name)
        for strand in self.strands.values():
            strand.order(Order(wish.drop, wish.add, wish.force))

    def _on_topology(self, name: str, payload: bytes) -> None:
        edges = decode(Topology, payload, name).edges
        if edges != self._edges:
            self._edges = edges
            for strand in self.strands.values():
                strand.strand.epochs.take_links(edges)

    def _show(self) -> None:
        """Ten times a second: states and progress, for who watches."""
        for strand in self.strands.values():
            strand.show()
