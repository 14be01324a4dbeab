"""The mesh service of one robot under virtual time: what `services.mesh.runner` and its main program do around the
node, without threads and sockets."""

import random
from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from typing import TypeVar

from services.mesh.bus_interface import BusInterface
from services.mesh.core.actions import Close, Dial, LinksChanged
from services.mesh.core.events import Received
from services.mesh.core.link.calls import Local, can_link, dials
from services.mesh.core.link.clock import ClockState
from services.mesh.core.link.session import Session
from services.mesh.core.node import MeshNode
from services.mesh.core.overlays.robot_overlays import RobotOverlays
from services.mesh.core.relay import KeyRelay
from services.mesh.core.routing.topology import Ground
from services.mesh.core.routing.wanted_links import InitialLinks
from sim.virtual.air import Air, ConnectionEnd
from sim.virtual.bus import VirtualBus
from sim.virtual.events import Time
from swarm.config import Config
from swarm.messages import Clock, EchoRequest, HoldLink, Links
from swarm.messages.keys import key

REPORT_PERIOD = 1.0
"""s between two publications of `mesh/links`, `mesh/clock` and `mesh/topology`, as the service has it."""

FIRST_INCARNATION = 1
"""Of every robot's floods."""

_NEVER = float("inf")

T = TypeVar("T")


class Common:
    """What the meshes of all robots have in common; made once, since it grows with the swarm."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.robots = {robot.name: robot for robot in config.robots}
        self.names = frozenset(self.robots)
        self.ground = Ground(config.names, config.edges, auto=config.auto)
        near: dict[str, set[str]] = {name: set() for name in config.names}
        for a, b in config.edges:
            near[a].add(b)
            near[b].add(a)
        self.near = {name: tuple(sorted(others)) for name, others in near.items()}

    def dials(self, robot: str) -> dict[str, bool]:
        """Whom a robot may be linked with, and whether it calls them: of a fixed topology its neighbours alone, or the
        tables of a thousand robots would hold a million entries that nobody uses."""
        own = self.robots[robot]
        others = self.names - {robot} if self.config.auto else self.near[robot]
        peers = (self.robots[name] for name in sorted(others))
        return {peer.name: dials(own, peer) for peer in peers if can_link(own, peer)}


class VirtualMesh:
    """One robot's mesh."""

    __slots__ = (
        "_air",
        "_bus",
        "_changed",
        "_clock_key",
        "_ends",
        "_links_key",
        "_time",
        "_timer",
        "_topology_key",
        "counters",
        "node",
        "robot",
        "running",
    )

    def __init__(
        self,
        common: Common,
        robot: str,
        time: Time,
        air: Air,
        bus: VirtualBus,
        seed: object,
        incarnation: int = FIRST_INCARNATION,
    ) -> None:
        """`incarnation` goes up with every start of the robot."""
        self.robot = robot
        self.running = True
        self.counters: Counter[str] = bus.counters
        self._time = time
        self._air = air
        self._bus = bus
        self._ends: dict[Session, ConnectionEnd] = {}
        self._timer = _NEVER
        self._changed = False
        # The text's hash is not Python's own, which differs from process to process.
        numbers = random.Random(f"{seed} {robot} mesh" + (f" {incarnation}" if incarnation > 1 else ""))
        config, settings = common.config, common.config.mesh
        local = Local(
            robot=robot,
            network=config.network,
            incarnation=numbers.getrandbits(64),
            insecure=True,
            dials=common.dials(robot),
            robots=common.names,
            heartbeat=settings.heartbeat,
            suspect=settings.suspect,
            dead=settings.dead,
        )
        relay = KeyRelay(robot, (), config.relay, common.names)
        overlays = RobotOverlays(
            robot,
            common.names,
            incarnation=incarnation,
            random=numbers.random,
            counters=self.counters,
            metric=settings.metric,
            process=local.process,
            start=InitialLinks(common.ground, local.dials, None),
            admits_flood=relay.admits_flood,
            admits_unicast=relay.admits_unicast,
            wanted=bus.wanted,
        )
        self.node = MeshNode(
            local,
            relay,
            overlays,
            random=numbers.random,
            nonce=partial(numbers.randbytes, 16),
            counters=self.counters,
        )
        BusInterface(bus, robot, self, relay.subscriptions, self.counters, lambda _: None)
        self._links_key = key(robot, "mesh", "links")
        self._clock_key = key(robot, "mesh", "clock")
        self._topology_key = key(robot, "mesh", "topology")
        air.add(self)
        time.soon(self._carry_out)
        # Robots are not switched on in the same microsecond: their reports do not all fall on one moment.
        time.at(time.now + REPORT_PERIOD * numbers.random(), self._report_regularly)

    @property
    def now(self) -> float:
        """By the robot's clock, s."""
        return self._time.now

    @property
    def sent(self) -> int:
        """Messages of apps that left, counted once for each neighbour."""
        return self.counters["sent_sync"]

    # -- what the bus wants -------------------------------------------------------------------------------------

    def publish(self, source: int, key: str, payload: bytes) -> None:
        """A sample of the own bus."""
        if self.running:
            self.node.publish(source, key, payload, self._time.now)
            self._carry_out()

    def ask(self, step: Callable[[RobotOverlays, float], object]) -> None:
        """Something for the overlays."""
        if self.running:
            self.node.ask(step, self._time.now)
            self._carry_out()

    def look(self, question: Callable[[RobotOverlays, float], T]) -> T:
        """Something the overlays know."""
        return question(self.node.overlays, self._time.now)

    def ping(self, request: EchoRequest) -> None:
        """Measure a link; what comes of it is published."""
        if self.running:
            self.node.ping(request, self._time.now)
            self._carry_out()

    def hold(self, request: HoldLink) -> None:
        """Have no link with a neighbour for a while."""
        if self.running:
            self.node.hold(request, self._time.now)
            self._carry_out()

    def clock(self) -> ClockState:
        """The mesh clock now."""
        return self.node.clock(self._time.now)

    # -- what the air calls ------------------------------------------------------------------------------------

    def dialled(self, peer: str, end: ConnectionEnd) -> None:
        """The connection asked for is there."""
        end.session = self.node.dialled(peer, self._time.now)
        self._ends[end.session] = end
        self._carry_out()

    def accepted(self, end: ConnectionEnd) -> None:
        """Somebody has called."""
        end.session = self.node.accepted(self._time.now)
        if end.session is None:
            self._air.close(end)
        else:
            self._ends[end.session] = end
        self._carry_out()

    def dial_failed(self, peer: str, reason: str) -> None:
        """The connection asked for could not be made."""
        self.node.dial_failed(peer, reason, self._time.now)
        self._carry_out()

    def receive(self, chunks: Iterable[tuple[ConnectionEnd, bytes]]) -> None:
        """What has come in this moment; b"" where the other end has closed."""
        node, now = self.node, self._time.now
        for end, data in chunks:
            if end.session is None:
                continue
            if data:
                node.receive(end.session, data, now)
            else:
                node.transport_down(end.session, "closed by the other end", now)
        self._carry_out()

    def stop(self) -> None:
        """End as the service does on SIGTERM: say goodbye, then close."""
        self.node.leave(self._time.now)
        self._carry_out()
        self.node.close(self._time.now)
        self._carry_out()
        self.kill()

    def kill(self) -> None:
        """End as by kill -9: the connections close, nothing is said."""
        self.running = False
        self._air.remove(self)
        for end in self._ends.values():
            self._air.close(end)
        self._ends.clear()
        self._bus.close()

    # -- inside ------------------------------------------------------------------------------------------------

    def _carry_out(self) -> None:
        """Send what is to be sent, and do what the node asks for."""
        node, ends = self.node, self._ends
        for session in node.ready():
            if (end := ends.get(session)) is not None:
                self._air.flush(end)
        for action in node.actions():
            if type(action) is Received:
                self._bus.publish(action.key, action.payload)
            elif type(action) is LinksChanged:
                self._tell_links()
            elif type(action) is Dial:
                self._air.dial(self, action.peer)
            elif type(action) is Close and (end := ends.pop(action.session, None)) is not None:
                self._air.flush(end)
                self._air.close(end)
        deadline = node.next_deadline()
        if deadline < self._timer:
            self._timer = deadline
            self._time.at(deadline, self._tick, deadline)

    def _tick(self, planned: float) -> None:
        if planned != self._timer or not self.running:
            return  # an earlier one came before
        self._timer = _NEVER
        self.node.handle_timer(self._time.now)
        self._carry_out()

    def _tell_links(self) -> None:
        """Once for all changes of a moment."""
        if not self._changed:
            self._changed = True
            self._time.soon(self._report)

    def _report_regularly(self) -> None:
        if self.running:
            self._report()
            self._time.at(self._time.now + REPORT_PERIOD, self._report_regularly)

    def _report(self) -> None:
        self._changed = False
        now, bus = self._time.now, self._bus
        if bus.wanted(self._topology_key):
            bus.publish(self._topology_key, self.node.overlays.topology(now))
        if bus.wanted(self._links_key):
            bus.publish(self._links_key, Links(now, self.node.links(), self.node.clashes(now)))
        if bus.wanted(self._clock_key):
            bus.publish(self._clock_key, Clock(*self.clock()))
