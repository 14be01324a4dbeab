"""The decoders of the mesh, for the fuzzer: bytes of a stranger, frames of a member, packets of the overlays."""

import random
from collections import Counter
from collections.abc import Callable, Sequence

from bench.decoders.run import Target
from services.mesh.core.bulk import pieces
from services.mesh.core.bulk.pieces import MessageId, Packet
from services.mesh.core.link import Received, neighbour
from services.mesh.core.link.calls import Local
from services.mesh.core.link.clock import ClockClaim, encode_claim
from services.mesh.core.link.flow import Fragment, Reassembly, decode_fragment, encode_ack, encode_fragment
from services.mesh.core.link.session import Session
from services.mesh.core.node import MeshNode
from services.mesh.core.overlays import carried, completion, stop
from services.mesh.core.overlays.carried import Carried
from services.mesh.core.overlays.completion import Known
from services.mesh.core.overlays.robot_overlays import RobotOverlays
from services.mesh.core.overlays.stop import Halt, Mark
from services.mesh.core.overlays.viewing import KEYS, Viewing
from services.mesh.core.relay import KeyRelay
from services.mesh.core.routing import topology
from services.mesh.core.routing.topology import Advertisement, Ground, TopologyVersion
from services.mesh.core.routing.wanted_links import InitialLinks
from services.mesh.core.wire import frames, packets
from services.mesh.core.wire.frames import BULK, CONTROL, FLOOD, NEIGHBOURS, SYNC, UNICAST, Bind, Heartbeat, Hello
from services.mesh.core.wire.packets import Ack, EchoPacket, Spread, UnicastMessage
from swarm.config.types import DEFAULT_RELAY
from swarm.core.lockstep.frames import encode_step
from swarm.errors import FrameError, PayloadError
from swarm.messages import Watch
from swarm.messages.codec import decode, encode

Made = tuple[Sequence[bytes], Callable[[bytes], object]]

NAMES = ("r0", "r1", "r2", "r3")
EDGES = (("r0", "r1"), ("r1", "r2"), ("r2", "r3"))
KEYS_OF_TEST = {1: bytes(range(32))}
SYNC_KEY = "swarm/r0/app/x/sync/00000000000000a1-0-3-9f3c21aa"

PACKETS = (
    packets.encode_spread(Spread(7, 5, b"x" * 20)),
    packets.encode_spread(Spread(7, 5, b"x" * 20, echo=True, first=2)),
    packets.encode_spread(Spread(7, 5, b"x", latest=True)),
    packets.encode_spread(Spread(7, 5, b"", echo=True, size=20_000)),
    packets.encode_spread(Spread(7, 9, topology.encode_advertisement(Advertisement({"r1": 300}, topology=5, heard=7)))),
    topology.encode_advertisement(Advertisement({"r1": 300, "r2": 65535}, leaving=True, heard=3)),
    packets.encode_spread(Spread(7, 6, b"x" * 20, known=0b101)),
    packets.encode_spread(Spread(7, 6, b"", size=20_000, known=0b101)),
    completion.encode_known(Known(7, 6, 0b111, final=True)),
    packets.encode_echo(EchoPacket(7, 5, ("r2", "r3"), lost=True, orphan=True, ttl=9)),
    *packets.encode_digests({"r2": (7, 5), "r3": (8, 6)}, answer=True),
    packets.encode_summary(77),
    *stop.encode_halts(Halt({"r2": (Mark(7, 5), "smoke")}, {"r3": Mark(8, 6)})),
    packets.encode_message(UnicastMessage("r0", "r1", 7, 5, "swarm/r0/app/x/send/r1", b"hello", 32)),
    packets.encode_message(UnicastMessage("r0", "r3", 7, 5, "swarm/r0/app/x/send/r3", b"hello", 32)),
    packets.encode_ack(Ack("r0", "r1", 7, 5, refused=False, ttl=32)),
    *(
        pieces.encode(Packet(kind, "r0", "r1", MessageId("r0", 7, 5, flood), body, 32))
        for kind, body in (
            (pieces.OFFER, pieces.encode_offer(5000, "swarm/r0/app/x/send/r1")),
            (pieces.WANT, pieces.encode_want(1, range(9))),
            (pieces.PIECE, pieces.encode_piece(1, bytes(pieces.SIZE))),
            (pieces.PIECE, pieces.encode_piece(2, bytes(5000 - 2 * pieces.SIZE))),
            (pieces.STATE, pieces.encode_state(pieces.LATER)),
            (pieces.GONE, b""),
        )
        for flood in (False, True)
    ),
    packets.encode_message(packets.UnicastMessage("r0", "r1", 7, 0, "swarm/r0/app/x/sync/1/r1/around", b"x", 9)),
    carried.encode_carried(Carried(0b1010, b"x" * 20, 32, latest=True)),
    Ground(NAMES, (), auto=True).encode(TopologyVersion(2, 1, "r0", True, EDGES)),
    encode(Watch(1.0, 5.0)),
)

CHANNELS = (
    (FLOOD, "swarm/r2/app/x/flood"), (FLOOD, "swarm/r2/mesh/lsa"), (FLOOD, "swarm/r3/mesh/lsa"),
    (FLOOD, "swarm/r0/mesh/halt"), (FLOOD, "swarm/r0/mesh/digest"), (FLOOD, "swarm/r0/mesh/topology"),
    (FLOOD, "swarm/r2/mesh/stopped"), (FLOOD, "swarm/r2/mesh/watch"), (FLOOD, "swarm/r1/app/x/flood"),
    (UNICAST, "swarm/r0/mesh/unicast"), (UNICAST, "swarm/r0/mesh/pieces"), (UNICAST, SYNC_KEY),
    (NEIGHBOURS, SYNC_KEY), (NEIGHBOURS, "swarm/r0/mesh/ping"), (NEIGHBOURS, "swarm/r0/mesh/pong"),
)  # fmt: skip
"""What the member's link may be bound to."""


def _overlays(rng: random.Random) -> RobotOverlays:
    """Those of r1, which has links with r0 and r2, and an automatic topology to plan."""
    start = InitialLinks(Ground(NAMES, (), auto=True), {name: True for name in NAMES if name != "r1"})
    return RobotOverlays(
        "r1",
        frozenset(NAMES),
        incarnation=10**15,
        random=rng.random,
        counters=Counter(),
        start=start,
        admits_flood=lambda key: True,
        admits_unicast=lambda sender, key: True,
        admits_neighbour=lambda sender, key: True,
        carries=lambda key: True,
    )


def _packets(rng: random.Random) -> Made:
    """Packets of the neighbour r0 to the overlays of r1, while time passes."""
    overlays = _overlays(rng)
    now = 1.0
    overlays.handle_timer(now)
    for peer in ("r0", "r2"):
        overlays.link_up(peer, now)
    overlays.actions()

    def feed(data: bytes) -> None:
        nonlocal now
        overlay, key = CHANNELS[int(rng.random() * 12)]
        overlays.receive("r0", overlay, key, data, (CONTROL, SYNC, BULK)[int(rng.random() * 3)], now)
        now += rng.random() * 0.02
        if rng.random() < 0.1:
            now += rng.random()
            overlays.handle_timer(now)
        if rng.random() < 0.01:
            overlays.link_down("r0", now)
            overlays.link_up("r0", now)
        if rng.random() < 0.01:
            encode(overlays.graph(now))
            encode(overlays.members(now))
            encode(overlays.stopped(now))
            encode(overlays.topology(now))
        for action in overlays.actions():
            if isinstance(action, Received):
                assert action.key

    return PACKETS, feed


def _decoders(decoders: Sequence[Callable[[bytes], object]]) -> Callable[[random.Random], Made]:
    def prepare(rng: random.Random) -> Made:
        def feed(data: bytes) -> object:
            return decoders[int(rng.random() * len(decoders))](data)

        return PACKETS, feed

    return prepare


def _topologies(rng: random.Random) -> Made:
    ground = Ground(NAMES, EDGES, auto=False)
    value = TopologyVersion(2, 1, "r0", False, EDGES)

    def feed(data: bytes) -> None:
        if rng.random() < 0.5:
            ground.decode(data)
        else:
            ground.from_file(data)

    return (ground.encode(value), ground.to_file(value)), feed


def _kept_stops(rng: random.Random) -> Made:
    """The file of a mesh in the runtime directory, which every program of the robot may write before the mesh does."""
    stops = Halt({name: (Mark(7, n), "smoke") for n, name in enumerate(NAMES)}, {NAMES[0]: Mark(7, 1)})
    return (stop.to_file(stops), stop.to_file(Halt({}, {}))), stop.from_file


def _local(robot: str, dials: dict[str, bool]) -> Local:
    return Local(robot, "lab", 10**15, False, dials, frozenset(NAMES), keys=KEYS_OF_TEST)


def _node(rng: random.Random) -> MeshNode:
    """The mesh of r1, which others call."""
    relay = KeyRelay("r1", ("r0", "r2"), DEFAULT_RELAY, NAMES)
    local = _local("r1", {"r0": False, "r2": False, "r3": True})
    return MeshNode(
        local, relay, _overlays(rng), random=rng.random, nonce=lambda: rng.randbytes(16), counters=Counter()
    )


HELLO = frames.encode_hello(Hello("lab", "r0", 5, bytes(16), True, False, (1,)))


def _stranger(rng: random.Random) -> Made:
    """Bytes of a caller without a key, each from a connection of its own."""
    node = _node(rng)
    now = 1.0
    golden = (
        HELLO,
        HELLO + frames.encode_confirm(bytes(32)),
        frames.encode_bye(frames.CLOSING),
        HELLO + frames.encode_heartbeat(Heartbeat(1, 2, 3)),
        frames.encode_hello(Hello("other", "r9", 5, bytes(16), False, True)),
    )

    def feed(data: bytes) -> None:
        nonlocal now
        now += 0.5
        session = node.accepted(now)
        assert session is not None
        session.data_to_send(now, 4096)
        node.connections.receive(session, data, now)
        assert not session.is_up
        node.connections.transport_down(session, "over", now)
        node.actions.take()
        node.connections.ready()

    return golden, feed


FRAMES = (
    frames.encode_heartbeat(Heartbeat(1_000_000, 2_000_000, 3_000_000)),
    encode_claim(ClockClaim("r0", 1, 5, 0, False, True, 5.0, 1e3, 1e-5, 1e-3)),
    frames.encode_bind(Bind(3, FLOOD, "swarm/r2/app/x/flood")),
    frames.encode_bye(frames.CLOSING),
    encode_ack(5),
    encode_fragment(Fragment(0, 0, False, 40, b"x" * 20)),
    encode_fragment(Fragment(0, 1, True, 0, b"x" * 20)),
    frames.encode_data(SYNC, 12, encode_step(5, bytes(8), bytes(8))),
    frames.encode_data(BULK, 13, neighbour._HEAD.pack(5, 1, 1) + bytes(9)),
)
"""Frames of a member beside those with packets: what is mutated is a frame without its length and tag."""


class _Member:
    """A member at the other end of a link with r1: it authenticates itself, and then says anything."""

    def __init__(self, node: MeshNode) -> None:
        self._node = node
        self._session: Session | None = None
        self._own: Session | None = None

    def say(self, frame: bytes, now: float) -> None:
        """An authenticated frame; the connection is made anew where the last one has ended it."""
        if self._session is None or not self._session.is_up:
            self._connect(now)
        assert self._session is not None
        assert self._own is not None
        assert self._own._auth is not None
        self._node.connections.receive(self._session, self._own._auth.seal([frame], b""), now)

    def _connect(self, now: float) -> None:
        node, local = self._node, _local("r0", {"r1": True})
        own = Session(
            local, bytes(16), now, dialled="r1", admit=lambda *_: True, clock=node.connections.clock, counters=Counter()
        )
        session = node.accepted(now)
        assert session is not None
        for _ in range(3):
            node.connections.receive(session, own.data_to_send(now, 4096), now)
            own.receive(session.data_to_send(now, 4096), now)
        assert session.is_up
        self._session, self._own = session, own
        for channel, (overlay, key) in enumerate(CHANNELS):
            self.say(frames.encode_bind(Bind(channel, overlay, key)), now)


def _member(rng: random.Random) -> Made:
    """Authenticated frames of the member r0: any kind with any body, and overlay packets on its channels."""
    node = _node(rng)
    now = 1.0
    node.handle_timer(now)
    member = _Member(node)

    def feed(data: bytes) -> None:
        nonlocal now
        now += rng.random() * 0.01
        if rng.random() < 0.8:
            channel, priority = int(rng.random() * len(CHANNELS)), int(rng.random() * 3)
            frame = frames.encode_data(priority, channel, data[: frames.MAX_PAYLOAD])
        else:
            # All but its length: a wrong one is for strangers, here it would only end the connection.
            body = data[2:4000]
            frame = len(body).to_bytes(2, "little") + body
            if not body:
                return
        member.say(frame, now)
        if rng.random() < 0.05:
            now += rng.random() * 0.3
            node.handle_timer(now)
        for session in node.connections.ready():
            session.data_to_send(now, 4096)
        node.actions.take()

    return (*FRAMES, *(frames.encode_data(BULK, 1, packet) for packet in PACKETS if len(packet) < 2000)), feed


def _fragments(rng: random.Random) -> Made:
    """Fragments of one peer, which the receiver puts together."""
    reassembly = Reassembly(Counter())
    now = 0.0

    def feed(data: bytes) -> None:
        nonlocal now
        now += rng.random() * 0.1
        reassembly.add(decode_fragment(data), now)

    return [each[3:] for each in FRAMES[5:7]], feed


def _view(rng: random.Random) -> Made:
    """What a robot tells of itself, by whatever its bus carries, to whoever asks."""
    viewing = Viewing("r1", 4)
    topics = [topic.replace("*", "x") for topic in KEYS]
    now = 0.0

    def feed(data: bytes) -> None:
        nonlocal now
        now += 0.1
        viewing.take(f"swarm/r1/{topics[int(rng.random() * len(topics))]}", data)
        if rng.random() < 0.2:
            viewing.asked(decode(Watch, data, "watch"), "r0", now)
        viewing.due(now)

    links = {"t": 1.0, "links": [{"peer": "r0", "state": "up", "rtt": 0.06, "sent_rate": 1e3, "reason": ""}]}
    return (encode(Watch(1.0, 60.0)), encode(links), encode({"x": 1.0, "y": 2.0, "quality": 5})), feed


_CORE = "services/mesh/core/"
_PACKET_DECODERS = (
    packets.decode_spread, packets.decode_echo, packets.decode_digest, packets.decode_summary, stop.decode_halt,
    topology.decode_advertisement, packets.decode_message, packets.decode_ack, neighbour._answer,
    pieces.decode, pieces.decode_offer, pieces.decode_want, pieces.decode_piece, pieces.decode_state,
    carried.decode_carried,
    completion.decode_known,
)  # fmt: skip

TARGETS = (
    Target("mesh: bytes of a stranger", (f"{_CORE}wire/frames.py",), _stranger, room=8),
    Target(
        "mesh: frames of a member",
        tuple(
            _CORE + each
            for each in (
                "wire/frames.py",
                "link/clock.py",
                "link/flow.py",
                "wire/packets.py",
                "link/neighbour.py",
            )
        ),
        _member,
        room=32,
    ),
    Target(
        "mesh: packets of the overlays",
        tuple(
            _CORE + each
            for each in (
                "wire/packets.py",
                "overlays/carried.py",
                "overlays/completion.py",
                "bulk/pieces.py",
                "overlays/stop.py",
                "routing/topology.py",
            )
        ),
        _packets,
        room=32,
    ),
    Target(
        "mesh: each packet by itself",
        (
            f"{_CORE}wire/packets.py",
            f"{_CORE}overlays/carried.py",
            f"{_CORE}overlays/completion.py",
            f"{_CORE}bulk/pieces.py",
            f"{_CORE}overlays/stop.py",
            f"{_CORE}routing/topology.py",
            f"{_CORE}link/neighbour.py",
        ),
        _decoders(_PACKET_DECODERS),
        (FrameError,),
    ),
    Target("mesh: fragments put together", (f"{_CORE}link/flow.py",), _fragments, (FrameError,)),
    Target("mesh: topologies, and their file", (f"{_CORE}routing/topology.py",), _topologies, (FrameError,)),
    Target("mesh: kept stops", (f"{_CORE}overlays/stop.py",), _kept_stops, (FrameError,)),
    Target("mesh: views of a robot", ("swarm/messages/codec.py",), _view, (PayloadError,)),
)
