"""The shell of a robot's mesh: joins the node with the robot's bus, its links and its clock.

The same code runs in a process, over sockets (`services.mesh.sockets`), and under virtual time
(`sim.virtual.radio.mesh`).
"""

import logging
import math
import threading
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

from services.mesh.core.actions import Close, Dial, LinksChanged, LogLine, Supervise, Write, WriteStops
from services.mesh.core.link import Received
from services.mesh.core.link.calls import UNKNOWN, Caller, Local, can_link, dials
from services.mesh.core.link.clock import ClockState
from services.mesh.core.link.session import SUSPECT, UP, Session
from services.mesh.core.node import MeshNode
from services.mesh.core.overlays.robot_overlays import RobotOverlays
from services.mesh.core.overlays.stop import Halt
from services.mesh.core.relay import KeyRelay
from services.mesh.core.routing.physical_links import CENTRAL, PERIPHERAL, SLOTS, is_bluetooth, is_measured, links_of
from services.mesh.core.routing.topology import Ground
from services.mesh.core.routing.wanted_links import InitialLinks
from services.mesh.core.wire.frames import BULK
from services.mesh.surroundings import Surroundings, Transport
from swarm.config import Config
from swarm.config.types import RobotConfig
from swarm.messages import Clock, EchoRequest, HoldLink, Links, LinkState
from swarm.messages.keys import key

REPORT_PERIOD = 1.0
"""Seconds between two publications of the mesh's own state (links, clock, topology, stops) when nothing changes."""

CLOSED = "closed by the other end"
"""The reason of a connection's end where the transport knows no better one."""

T = TypeVar("T")


class Chance(NamedTuple):
    """The random numbers of a mesh."""

    random: Callable[[], float]
    """Gives uniform numbers from 0 up to 1."""
    nonce: Callable[[], bytes]
    """Gives 16 bytes that nobody can foresee."""


def dials_of(
    own: RobotConfig, peers: Iterable[RobotConfig], calls: Collection[tuple[str, str]] = ()
) -> dict[str, bool]:
    """Return those of `peers` that a robot may be linked with, and whether it dials them: as `calls` has it, whose
    pairs begin with who does, and by `dials` where a pair is not there."""
    found = {peer.name: dials(own, peer) for peer in peers if peer is not own and can_link(own, peer)}
    for caller, called in calls:
        if own.name == caller and called in found:
            found[called] = True
        elif own.name == called and caller in found:
            found[caller] = False
    return found


def ground_of(config: Config) -> Ground:
    """Return what all topologies of a configuration have in common."""
    return Ground(config.names, config.edges, auto=config.auto, links=links_of(config), measured=is_measured(config))


def local_of(
    config: Config,
    robot: str,
    robots: frozenset[str],
    dials: dict[str, bool],
    incarnation: int,
    *,
    insecure: bool,
    keys: Mapping[int, bytes],
) -> Local:
    """Return what the links of a robot have in common, by its configuration."""
    return Local(
        robot=robot,
        network=config.network,
        incarnation=incarnation,
        insecure=insecure,
        dials=dials,
        robots=robots,
        times=config.mesh,
        pages=is_bluetooth(config),
        keys=keys,
    )


class Mesh:
    """The mesh of one robot. Only one call at a time may run: other threads use its methods through
    `Surroundings.entry`."""

    def __init__(
        self,
        config: Config,
        local: Local,
        start: InitialLinks,
        chance: Chance,
        incarnation: int,
        surroundings: Surroundings,
        transport: Transport,
        *,
        keep: Callable[[bytes], None],
        keep_stops: Callable[[bytes], None],
        stops: Halt | None = None,
        heard: Callable[[str, bytes], None] | None = None,
        wanted: Callable[[str], bool] = lambda key: True,
        role_of: Callable[[str], str] = lambda robot: "",
    ) -> None:
        """`incarnation`: of its floods, higher than at its last start. `keep(data)` keeps the topology through
        restarts, and `keep_stops(data)` the stops; `stops` are those of the process before. `heard(key, payload)` gets
        what came in, before the bus; `wanted(key)` tells whether anybody hears a key on the own bus, where that can be
        known at any time. `role_of(robot)` is this robot's role in its connection to another one, `LinkState.role`."""
        robot = self.robot = local.robot
        self._dials = local.dials
        self._role_of = role_of
        self._simulated_radio = (config.robot(robot).link or "").startswith(SLOTS)
        self.running = True
        """False after its end: it does nothing any more."""
        counters = surroundings.counters
        self._surroundings = surroundings
        self._transport = transport
        self._bus = surroundings.bus
        self._keep = keep
        self._keep_stops = keep_stops
        self._heard = heard
        self._deadline: float | None = None
        """The deadline that the transport was told last; None after that time has come."""
        self._paced: dict[Session, float] = {}
        """The times at which sessions are flushed again, since the pace of their bulk holds it back until then."""
        self._changed = False
        """Whether a report is planned."""
        self._reporting, self._keeping = threading.Lock(), threading.Lock()
        """Around what is done outside, so that the newest state is the last one."""
        # Who is reached over links of others is reached over whatever ways there are: around leads nowhere else.
        rules = [rule for rule in config.relay if rule.overlay != "around" or not start.ground.carried]
        relay = KeyRelay(robot, (), rules, local.robots)
        self.subscriptions = relay.subscriptions
        """The key expressions of the own bus that relay rules name; `publish` gets the index in here."""
        overlays = RobotOverlays(
            robot,
            local.robots,
            incarnation=incarnation,
            random=chance.random,
            counters=counters,
            metric=config.mesh.metric,
            process=local.process,
            start=start,
            admits_flood=relay.admits_flood,
            admits_unicast=relay.admits_unicast,
            admits_neighbour=relay.admits_neighbour,
            carries=relay.carries,
            wanted=wanted,
        )
        self._node = MeshNode(local, relay, overlays, random=chance.random, nonce=chance.nonce, counters=counters)
        self._look = surroundings.entry(self._ask_node)
        self._reports: dict[str, Callable[[MeshNode, float], object]] = {
            key(robot, "mesh", "topology"): lambda node, now: node.overlays.topology(now),
            key(robot, "mesh", "links"): lambda node, now: self.links(),
            # A balancer may have heard of a stop that no mesh knows any more.
            key(robot, "mesh", "stopped"): lambda node, now: node.overlays.stopped(now),
            key(robot, "mesh", "clock"): lambda node, now: Clock(*node.connections.clock.state(now)),
        }
        """The mesh's own state by key, in the order of publication."""
        if stops is not None:
            self._node.ask(lambda overlays, now: overlays.restore_stops(stops, now), surroundings.now)
        surroundings.soon(self.carry_out)
        # Robots are not switched on in the same microsecond: their reports do not all fall on one moment.
        surroundings.at(surroundings.now + REPORT_PERIOD * chance.random(), self._report_regularly)

    # -- what the bus wants ------------------------------------------------------------------------------------

    def publish(self, source: int | None, key: str, payload: bytes) -> None:
        """Relay a sample of the own bus; `source` as of `MeshNode.publish`."""
        if self.running:
            self._node.publish(source, key, payload, self._surroundings.now)
            self.carry_out()

    def ask(self, step: Callable[[RobotOverlays, float], object]) -> None:
        """Let the overlays do something."""
        if self.running:
            self._node.ask(step, self._surroundings.now)
            self.carry_out()

    def look(self, question: Callable[[RobotOverlays, float], T]) -> T:
        """Return what the overlays answer."""
        return question(self._node.overlays, self._surroundings.now)

    def ping(self, request: EchoRequest) -> None:
        """Measure a link; the answers are published."""
        if self.running:
            self._node.connections.ping(request, self._surroundings.now)
            self.carry_out()

    def hold(self, request: HoldLink) -> None:
        """Have no link with a neighbour for a while."""
        if self.running:
            self._node.connections.hold(request, self._surroundings.now)
            self.carry_out()

    def clock(self) -> ClockState:
        """Return the mesh clock."""
        return self._node.connections.clock.state(self._surroundings.now)

    def links(self) -> Links:
        """Return all links as they are, and the names that two robots have."""
        now = self._surroundings.now
        states = tuple(map(self._with_role, self._node.connections.states()))
        return Links(now, states, self._node.overlays.clashes.named(now))

    def stop(self) -> None:
        """Say goodbye to the neighbours and end all connections."""
        self._node.leave(self._surroundings.now)
        self.carry_out()
        self._node.connections.close(self._surroundings.now)
        self.carry_out()
        self.running = False

    # -- what the transport tells --------------------------------------------------------------------------------

    def dialled(self, peer: str) -> Session:
        """Return the session of the connection that was asked for. When the transport can serve it, `carry_out`."""
        return self._node.dialled(peer, self._surroundings.now)

    def accepted(self, caller: Caller = UNKNOWN) -> Session | None:
        """Return the session of a connection that somebody made; None: the transport is to close it. Then `carry_out`
        as after `dialled`."""
        return self._node.accepted(self._surroundings.now, caller)

    def dial_failed(self, peer: str, reason: str) -> None:
        """The connection asked for could not be made."""
        self._node.connections.dial_failed(peer, reason, self._surroundings.now)
        self.carry_out()

    def received(self, arrivals: Iterable[tuple[Session, bytes | str]]) -> None:
        """Take what has arrived together: bytes, or the reason for which a connection has ended."""
        connections, now = self._node.connections, self._surroundings.now
        for session, data in arrivals:
            if type(data) is bytes:
                connections.receive(session, data, now)
            else:
                assert type(data) is str
                connections.transport_down(session, data, now)
        self.carry_out()

    def due(self) -> None:
        """The time told to `Transport.wake` has come."""
        if self.running:
            self._deadline = None
            now = self._surroundings.now
            if now >= self._node.next_deadline():
                self._node.handle_timer(now)
            for session, at in tuple(self._paced.items()):
                if now >= at:
                    del self._paced[session]
                    self._transport.flush(session)
            self.carry_out()

    def flushed(self, session: Session, now: float) -> None:
        """A session has given all that leaves at `now`. Where its pace holds bulk back, it is flushed again in time."""
        if now < (at := session.resumes) < math.inf:
            self._paced[session] = at
            if self._deadline is None or at < self._deadline:
                self._deadline = at
                self._transport.wake(at)

    def carry_out(self) -> None:
        """Send what is to be sent, and do what the node asks for."""
        node, transport = self._node, self._transport
        for session in node.connections.ready():
            transport.flush(session)
        if actions := node.actions.take():
            outside = self._surroundings.outside
            for action in actions:
                kind = type(action)
                if kind is Received:
                    outside(self._deliver, action)
                elif kind is LinksChanged:
                    self._links_changed()
                elif type(action) is LogLine:
                    level = logging.WARNING if action.problem else logging.INFO
                    outside(self._surroundings.log.log, level, "%s", action.text)
                elif type(action) is Dial:
                    transport.dial(action.peer)
                elif type(action) is Close:
                    transport.close(action.session)
                elif type(action) is Supervise:
                    transport.supervise(action.session, action.seconds)
                elif kind is Write:
                    outside(self._write, self._keep, RobotOverlays.topology_file)
                elif kind is WriteStops:
                    outside(self._write, self._keep_stops, RobotOverlays.stops_file)
        deadline = min((node.next_deadline(), *self._paced.values()))
        if deadline != self._deadline:
            self._deadline = deadline
            transport.wake(deadline)

    # -- outside -------------------------------------------------------------------------------------------------

    def _deliver(self, message: Received) -> None:
        if self._heard is not None:
            self._heard(message.key, message.payload)
        self._bus.publish(message.key, message.payload, urgent=message.priority < BULK)

    def _write(self, keep: Callable[[bytes], None], content: Callable[[RobotOverlays], bytes]) -> None:
        with self._keeping:
            keep(self._look(lambda node, now: content(node.overlays)))

    def _publish_report(self) -> None:
        with self._reporting:
            for name, report in self._reports.items():
                if self._bus.wanted(name):
                    self._bus.publish(name, self._look(report))

    # -- inside --------------------------------------------------------------------------------------------------

    def _ask_node(self, question: Callable[[MeshNode, float], Any]) -> Any:
        return question(self._node, self._surroundings.now)

    def _with_role(self, link: LinkState) -> LinkState:
        wanted = CENTRAL if self._dials.get(link.peer) else PERIPHERAL
        role = self._role_of(link.peer)
        if self._simulated_radio and link.state in (UP, SUSPECT):
            role = wanted  # it switches roles as asked
        return replace(link, role=role, wanted_role=wanted) if role else link

    def _links_changed(self) -> None:
        """Report once for all changes of a moment."""
        if not self._changed:
            self._changed = True
            self._surroundings.soon(self._report)

    def _report_regularly(self) -> None:
        if self.running:
            self._report()
            self._surroundings.at(self._surroundings.now + REPORT_PERIOD, self._report_regularly)

    def _report(self) -> None:
        self._changed = False
        self._surroundings.outside(self._publish_report)
