"""Nodes of the mesh joined in memory under virtual time, with cuts, broken connections, kills and stops."""

import random
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

from timed_world import NEVER, TimedWorld, Timer

from services.mesh.core.actions import Close, Dial, LogLine, Write
from services.mesh.core.link import Received
from services.mesh.core.link.calls import UNKNOWN, Caller, Local, dials
from services.mesh.core.link.session import Session
from services.mesh.core.node import MeshNode
from services.mesh.core.overlays.robot_overlays import RobotOverlays
from services.mesh.core.relay import KeyRelay
from services.mesh.core.routing.topology import Ground, TopologyVersion
from services.mesh.core.routing.wanted_links import InitialLinks
from services.mesh.links.radio_model import AirModel, DelayLine
from swarm.config.types import DEFAULT_RELAY, RelayRule, RobotConfig
from swarm.messages import LinkState

SOCKET = 50_000
"""Bytes that an RFCOMM socket takes."""


@dataclass
class End:
    """One end of a connection."""

    robot: str
    session: Session | None
    peer: "End | None" = None
    alive: bool = True
    broken: bool = False
    """The rest of what it sends is lost, as on a stream: never bytes from the middle."""
    heard: bytearray = field(default_factory=bytearray)
    """What arrived here, where it is a stranger's end."""
    line: DelayLine | None = None
    """The air from here to the other end, where it has a bandwidth."""
    socket: deque[bytes] = field(default_factory=deque)
    """Writes that wait for the air."""
    waits: bool = False
    """Whether it will go on with them by itself."""
    resumes: float = 0.0
    """When it looks again for bulk that its pace held back."""


@dataclass
class Bot:
    """One robot's mesh and what came out of it."""

    name: str
    node: MeshNode
    counters: Counter[str]
    ends: dict[Session, End] = field(default_factory=dict)
    inbox: list[tuple[str, bytes]] = field(default_factory=list)
    notes: list[LogLine] = field(default_factory=list)
    stopped_until: float = 0.0


class World(TimedWorld):
    """Robots and the links between them. Time passes only in `run`."""

    def __init__(
        self,
        edges: Sequence[tuple[str, str]],
        *,
        rules: Sequence[RelayRule] = DEFAULT_RELAY,
        latency: float = 0.03,
        seed: int = 0,
        keys: Mapping[int, bytes] | None = None,
        bandwidth: float | None = None,
        jitter: float = 0.0,
        auto: bool = False,
    ) -> None:
        """With `keys` all links are authenticated; a robot's own ones may be put into `overrides`. With a `bandwidth`,
        bytes/s, each end has a socket of 50 kB before the air. With `auto` the robots find their links themselves."""
        super().__init__()
        self.air = AirModel(latency, jitter, bandwidth)
        self.written: Counter[tuple[str, str]] = Counter()
        """Bytes on the air from one robot to another."""
        self.auto = auto
        self.topology: Sequence[tuple[str, str]] = () if auto else list(edges)
        """The configuration's."""
        self.saved: dict[str, TopologyVersion] = {}
        """What robots have kept through their restarts."""
        self.keys = keys
        self.random = random.Random(seed)
        self.latency = latency
        self.edges = list(edges)
        self.rules = rules
        self.network = {name: "lab" for edge in edges for name in edge}
        self.overrides: dict[str, dict[str, object]] = {}
        self.callers: dict[str, Caller] = {}
        """What the transport knows of robots that call; nothing of the others."""
        self.bots: dict[str, Bot] = {}
        self.cuts: dict[frozenset[str], float] = {}
        self.dials: list[tuple[float, str, str]] = []
        self.break_after: int | None = None
        self.tap: Callable[[End, bytes], bytes] | None = None
        """Somebody between the robots: sees what an end sends, and decides what goes on in its place."""
        for name in self.network:
            self.start(name)

    # -- what a test does --

    def start(self, name: str) -> None:
        """Start a robot's mesh, anew if it was there."""
        robots = {each: RobotConfig(each) for each in self.network}
        peers = sorted({peer for edge in self.edges if name in edge for peer in edge if peer != name})
        settings: dict[str, object] = {
            "robot": name,
            "network": self.network[name],
            "incarnation": self.random.getrandbits(64),
            "insecure": self.keys is None,
            "keys": self.keys or {},
            "dials": {peer: dials(robots[name], robots[peer]) for peer in robots if peer != name},
            "robots": frozenset(robots),
        }
        local = Local(**(settings | self.overrides.get(name, {})))  # type: ignore[arg-type]
        counters: Counter[str] = Counter()
        relay = KeyRelay(local.robot, peers, self.rules, local.robots)
        overlays = RobotOverlays(
            local.robot,
            local.robots,
            incarnation=int((1000.0 + self.now) * 1e6),
            random=self.random.random,
            counters=counters,
            process=local.process,
            start=InitialLinks(
                Ground(sorted(local.robots), self.topology, auto=self.auto), local.dials, self.saved.get(name)
            ),
            admits_flood=relay.admits_flood,
            admits_unicast=relay.admits_unicast,
        )
        node = MeshNode(
            local,
            relay,
            overlays,
            random=self.random.random,
            nonce=lambda: self.random.randbytes(16),
            counters=counters,
        )
        self.bots[name] = Bot(name, node, counters)
        self.step(name, lambda node: node.handle_timer(self.now))

    def kill(self, name: str) -> None:
        """End a mesh as kill -9 does: its connections close, nothing is said."""
        for end in self.bots.pop(name).ends.values():
            self._close(end)

    def stop(self, name: str, seconds: float) -> None:
        """Stop a mesh as SIGSTOP does: its connections stay, it does nothing."""
        self.bots[name].stopped_until = self.now + seconds

    def cut(self, a: str, b: str, seconds: float) -> None:
        """Nothing passes between two robots for a while; what is under way arrives afterwards."""
        self.cuts[frozenset((a, b))] = self.now + seconds

    def break_connections(self, name: str) -> None:
        """All connections of a robot are lost; both ends notice."""
        for end in list(self.bots[name].ends.values()):
            peer = end.peer
            self._close(end)
            if peer is not None:
                self._close(peer)
            self._down(end)

    def publish(self, name: str, key: str, payload: bytes, source: int = 0) -> None:
        """A sample on a robot's own bus."""
        self.step(name, lambda node: node.publish(source, key, payload, self.now))

    def connect_raw(self, name: str, *writes: bytes, caller: Caller = UNKNOWN) -> "Raw":
        """A stranger connects and writes."""
        raw = Raw(self, End("stranger", None))
        end = End(name, None, raw.end)
        raw.end.peer = end
        self._accept(end, caller)
        for data in writes:
            raw.write(data)
        return raw

    def link(self, name: str, peer: str) -> LinkState:
        """A link as one robot sees it."""
        (state,) = (state for state in self.bots[name].node.connections.states() if state.peer == peer)
        return state

    def all_up(self) -> bool:
        """Whether both ends of every link see it up."""
        return all(self.link(a, b).state == "up" == self.link(b, a).state for a, b in self.edges)

    def timers(self) -> list[Timer]:
        return [(self._wake(self.bots[name]), partial(self._handle_timer, name)) for name in sorted(self.bots)]

    # -- the machinery --

    def step(self, name: str, call: Callable[[MeshNode], object]) -> None:
        """Call a node and carry out what it wants."""
        bot = self.bots[name]
        call(bot.node)
        for session in bot.node.connections.ready():
            if session in bot.ends:
                self._flush(bot.ends[session])
        for action in bot.node.actions.take():
            if isinstance(action, Received):
                if action.key.endswith(("/mesh/members", "/mesh/passed", "/mesh/topology")):
                    continue
                bot.inbox.append((action.key, action.payload))
            elif isinstance(action, Dial):
                self.dials.append((self.now, name, action.peer))
                self.at(self.now + self.latency, lambda peer=action.peer: self._dial(bot, peer))  # type: ignore[misc]
            elif isinstance(action, Close):
                if (end := bot.ends.pop(action.session, None)) is not None:
                    end.session = action.session
                    self._flush(end)
                    self._close(end)
            elif isinstance(action, LogLine):
                bot.notes.append(action)
            elif isinstance(action, Write):
                linking = bot.node.overlays.linking
                assert linking is not None
                self.saved[name] = linking.value

    def _wake(self, bot: Bot) -> float:
        deadline = bot.node.next_deadline()
        assert deadline <= bot.node._earliest(), "something would be done too late"
        return max(deadline, bot.stopped_until)

    def _handle_timer(self, name: str) -> None:
        self.step(name, lambda node: node.handle_timer(self.now))

    def _is_cut(self, a: str, b: str) -> bool:
        return self.cuts.get(frozenset((a, b)), 0.0) > self.now

    def _dial(self, caller: Bot, peer: str) -> None:
        if self.bots.get(caller.name) is not caller:
            return
        if peer not in self.bots or self._is_cut(caller.name, peer):
            self.step(caller.name, lambda node: node.connections.dial_failed(peer, "unreachable", self.now))
            return
        near, far = End(caller.name, None), End(peer, None)
        near.peer, far.peer = far, near

        def dialled(node: MeshNode) -> None:
            near.session = node.dialled(peer, self.now)
            caller.ends[near.session] = near

        self.step(caller.name, dialled)
        self._accept(far, self.callers.get(caller.name, UNKNOWN))

    def _accept(self, end: End, caller: Caller = UNKNOWN) -> None:
        bot = self.bots[end.robot]

        def accepted(node: MeshNode) -> None:
            end.session = node.accepted(self.now, caller)
            if end.session is None:
                self._close(end)
            else:
                bot.ends[end.session] = end

        self.step(end.robot, accepted)

    def _flush(self, end: End) -> None:
        assert end.session is not None
        if self.air.bandwidth is not None:
            self._write(end)
            self._resume(end)
            return
        while data := end.session.data_to_send(self.now, 4096):
            if self.tap is not None:
                data = self.tap(end, data)
            while data:
                cut = self.random.randint(1, len(data))
                self.send(end, data[:cut])
                data = data[cut:]
        self._resume(end)

    def _write(self, end: End) -> None:
        """From the session into the socket, from there onto the air at its own pace."""
        if end.line is None:
            end.line = DelayLine(self.air, self.random)
        session, line, other = end.session, end.line, end.peer
        assert session is not None
        while sum(map(len, end.socket)) < SOCKET and (data := session.data_to_send(self.now, 4096)):
            end.socket.append(data)
        waited = bool(end.socket)
        while end.socket and line.free_at <= self.now:
            data = end.socket.popleft()
            self.written[end.robot, other.robot if other is not None else ""] += len(data)
            line.push(data, self.now)
            self.at(line._last_arrival, lambda data=data: self._arrive(end, data))  # type: ignore[misc]
        if waited and not end.waits:
            end.waits = True
            self.at(line.free_at, lambda: self._go_on(end))

    def _resume(self, end: End) -> None:
        """Go on when the pace of what waits allows it, as `Mesh.flushed` does."""
        assert end.session is not None
        if self.now < (at := end.session.resumes) < NEVER and at != end.resumes:
            end.resumes = at
            self.at(at, lambda: self._flush(end) if end.alive else None)

    def _go_on(self, end: End) -> None:
        end.waits = False
        if end.alive:
            self._flush(end)

    def send(self, end: End, data: bytes) -> None:
        """Put bytes on the way to the other end."""
        if end.broken:
            return
        if self.break_after is not None:
            data, self.break_after = data[: self.break_after], self.break_after - len(data)
        if data:
            self.at(self.now + self.latency, lambda: self._arrive(end, data))
        if self.break_after is not None and self.break_after <= 0:
            self.break_after = None
            end.broken = True
            self.at(self.now + self.latency, lambda: self._lose(end))

    def _lose(self, end: End) -> None:
        self._close(end)
        self._down(end)

    def _arrive(self, sender: End, data: bytes) -> None:
        receiver = sender.peer
        if receiver is not None and receiver.robot == "stranger":
            receiver.heard += data
        if receiver is None or receiver.session is None or not receiver.alive:
            return
        bot = self.bots.get(receiver.robot)
        if bot is None or receiver.session not in bot.ends:
            return
        held = max(bot.stopped_until, self.cuts.get(frozenset((sender.robot, receiver.robot)), 0.0))
        if held > self.now:
            # What follows was queued later for the same time, so the order stays.
            self.at(held, lambda: self._arrive(sender, data))
            return
        session = receiver.session
        self.step(receiver.robot, lambda node: node.connections.receive(session, data, self.now))

    def _close(self, end: End) -> None:
        """This end is gone: the other one notices after the latency."""
        if end.alive:
            end.alive = False
            if end.peer is not None:
                self.at(self.now + self.latency, lambda peer=end.peer: self._down(peer))  # type: ignore[misc]

    def _down(self, end: End) -> None:
        bot = self.bots.get(end.robot)
        if bot is None or end.session is None or end.session not in bot.ends:
            return
        other = end.peer.robot if end.peer is not None else ""
        held = max(bot.stopped_until, self.cuts.get(frozenset((end.robot, other)), 0.0))
        if held > self.now:
            self.at(held, lambda: self._down(end))
            return
        session = end.session
        self.step(end.robot, lambda node: node.connections.transport_down(session, "connection reset", self.now))


class Raw:
    """A caller that is no node."""

    def __init__(self, world: World, end: End) -> None:
        self.world = world
        self.end = end

    def write(self, data: bytes) -> None:
        """Send any bytes."""
        self.world.send(self.end, data)

    @property
    def heard(self) -> bytes:
        """What the robot has sent."""
        return bytes(self.end.heard)

    @property
    def open(self) -> bool:
        """Whether the robot still holds the connection."""
        return self.end.peer is not None and self.end.peer.alive
