"""The graph of the swarm: which links it is to have, which links robots tell of, and the shortest ways over them.

`TopologyVersion` is a value that can be changed at run time, and is the same everywhere in the end. Values have a total
order, that of their fields: the version first (an operator's sets), then the step (what the automatic rule changes
within a version), then the issuer's name, then the content. Of two values the greater one holds, so two sets at once
end alike on every robot. Version 0 is what the configuration says; a value belongs to one configuration
(`Ground.base`), and another configuration makes it void.

`Advertisement` is what a robot tells of the links that it has, the payload of a link-state advertisement. `routes` are
the shortest paths (Dijkstra 1959; with hops as metric it is the thesis' breadth-first search, algorithm 2).
"""

import heapq
import struct
import zlib
from collections.abc import Collection, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

from services.mesh.core.routing.physical_links import physical
from services.mesh.core.wire.packets import TOPOLOGY, PacketReader, packed
from swarm.config.types import GRAPH, MAX_RFCOMM_LINKS
from swarm.core.graph import Edge, Graph
from swarm.errors import FrameError, LocalError

MAX_TWINS = 16
"""Names that one LSA tells of as those of two robots."""

MAX_LINKS = MAX_RFCOMM_LINKS
"""Links of one robot, whatever they run over."""

AUTO = "auto"
"""The value in place of a shape with which robots find their neighbours themselves."""

MAX_VERSION = MAX_STEP = (1 << 32) - 1

_LSA = struct.Struct("<BB")
_COUNT = struct.Struct("<B")
_METRIC = struct.Struct("<H")
_U32 = struct.Struct("<I")
_SMALL = 256
"""Bytes of an LSA whose decoded form is remembered: 1024 of them take 2 MB, whatever peers send."""

_HEAD = struct.Struct("<BBIII")
_INDEX = struct.Struct("<H")
_CHOICE = struct.Struct("<HHH")
_AUTO, _CHOSEN, _TRIAL = 1, 2, 4
MAX_ROUND_TRIP = 65535
"""ms that a choice of the hub tells at most."""
_MAGIC = b"BSTOPO1\n"
_CHECK = struct.Struct("<I")
_MAX_SHOWN = 8


class Hub(NamedTuple):
    """The choice of the robot that calls all others (`routing.hub_choice`). Robots are given by their places in the
    configuration."""

    place: int = 0
    before: int = 0
    """The hub before this one."""
    round_trip: int = 0
    """Mean round trip between that hub and the robots in its reach, ms; 0: not measured."""
    trial: bool = False
    """Whether the hub is on trial. Otherwise it stays, or has been handed back."""


class TopologyVersion(NamedTuple):
    """A version of the topology of the whole swarm. Later ones are greater."""

    version: int
    """Counts an operator's sets, u32; 0 = as configured."""
    step: int
    """Counts the changes of the automatic rule and of the hub within a version, u32."""
    issuer: str
    """The robot it was set on; empty for version 0, step 0."""
    auto: bool
    """Whether the automatic rule may change it."""
    edges: tuple[Edge, ...]
    hub: Hub = Hub()

    def neighbours(self, name: str) -> frozenset[str]:
        """Return the neighbours of a robot."""
        return ends(self.edges, name)


def ends(edges: Collection[Edge], name: str) -> frozenset[str]:
    """Return the other ends of a robot's edges."""
    return frozenset(b if a == name else a for a, b in edges if name in (a, b))


class Ground:
    """The common part of all topologies of one configuration: the robots, and the first links."""

    def __init__(
        self, names: Sequence[str], edges: Collection[Edge], *, auto: bool, links: str = GRAPH, measured: bool = False
    ) -> None:
        """`links`: which links carry a topology, see `routing.physical_links`; `measured`: whether round trips decide
        which robot is the hub."""
        self.names = tuple(names)
        self._links = links
        self.carried = links != GRAPH
        """Whether these are others than the topology's own."""
        self.measured = measured
        self.first = TopologyVersion(0, 0, "", auto, Graph(names, tuple(edges)).edges)
        """The configuration's own."""
        self.place = {name: index for index, name in enumerate(self.names)}
        text = f"{' '.join(self.names)} {self.first.edges} {auto}" + (f" {links}" if self.carried else "")
        self.base = zlib.crc32(text.encode())
        """Tells configurations apart."""
        # A value goes over every link that comes up, and is mostly the same one: in a swarm of a thousand robots making
        # and reading it took more than all else of the start.
        self._packet = (self.first, self._encode(self.first))
        self._read: dict[bytes, TopologyVersion] = {self._packet[1]: self.first}

    def edge(self, a: str, b: str) -> Edge:
        """Return the link of two robots as it stands in a graph."""
        return (a, b) if self.place[a] < self.place[b] else (b, a)

    def physical(self, value: TopologyVersion) -> tuple[Edge, ...]:
        """Return the links that carry a value."""
        return physical(self.order(value), value.edges, self._links)

    def order(self, value: TopologyVersion) -> tuple[str, ...]:
        """Return the robots in the order of hubs: the chosen one, then the others as in the configuration."""
        hub = value.hub.place
        return (self.names[hub], *self.names[:hub], *self.names[hub + 1 :])

    def edges_of(self, shape: str, edges: Collection[Sequence[str]]) -> tuple[Edge, ...]:
        """Return the links that an operator asks for by a shape, or one by one; `LocalError` says what is wrong with
        them."""
        if shape:
            graph = Graph.of_shape(shape, self.names)
        else:
            for pair in edges:
                if len(pair) != 2:
                    raise LocalError(f"a link has two ends, got {' '.join(pair)[:80]!r}")
            graph = Graph(self.names, [(pair[0], pair[1]) for pair in edges])
        _check(graph)
        if not graph.is_connected():
            parts = graph.components()
            shown = "; ".join(" ".join(part[:_MAX_SHOWN]) for part in parts[:_MAX_SHOWN])
            raise LocalError(f"not connected: these parts could not reach each other: {shown}")
        return graph.edges

    def tag(self, value: TopologyVersion) -> int:
        """Return a short name of a value for link states, u32; 0 = the configuration's own."""
        return 0 if value == self.first else zlib.crc32(self.encode(value)) or 1

    def encode(self, value: TopologyVersion) -> bytes:
        """Encode a TOPOLOGY packet: head, issuer, the choice of the hub if there is one, then for each robot its
        neighbours that come later in the configuration."""
        if self._packet[0] is not value:
            self._packet = (value, self._encode(value))
        return self._packet[1]

    def _encode(self, value: TopologyVersion) -> bytes:
        issuer = value.issuer.encode()
        hub = value.hub
        chosen = b"" if hub == Hub() else _CHOICE.pack(hub.place, hub.before, hub.round_trip)
        flags = value.auto * _AUTO | bool(chosen) * _CHOSEN | hub.trial * _TRIAL
        head = _HEAD.pack(TOPOLOGY, flags, self.base, value.version, value.step)
        later: list[list[int]] = [[] for _ in self.names]
        for a, b in value.edges:
            later[self.place[a]].append(self.place[b])
        rows = b"".join(bytes((len(row),)) + b"".join(map(_INDEX.pack, sorted(row))) for row in later)
        return head + bytes((len(issuer),)) + issuer + chosen + rows

    def decode(self, data: bytes) -> TopologyVersion | None:
        """Return the value in a TOPOLOGY packet; None where it belongs to another configuration. Raises
        `FrameError`."""
        if (known := self._read.get(data)) is not None:
            return known
        if len(data) <= _HEAD.size:
            raise FrameError(f"TOPOLOGY of {len(data)} bytes: it has more than {_HEAD.size}")
        kind, flags, base, version, step = _HEAD.unpack_from(data)
        if kind != TOPOLOGY or flags & ~(_AUTO | _CHOSEN | _TRIAL):
            raise FrameError(f"TOPOLOGY kind {kind}, flags {flags:#x}: kind {TOPOLOGY} and bits 0 to 2 are known")
        if flags & _TRIAL and not flags & _CHOSEN:
            raise FrameError("TOPOLOGY: a trial of no hub")
        if base != self.base or (flags & _CHOSEN and not self.measured):
            return None
        at = _HEAD.size + 1
        end = at + data[at - 1]
        issuer = data[at:end].decode("ascii", "replace")
        hub = Hub()
        if flags & _CHOSEN:
            hub, end = self._hub(data, end, trial=bool(flags & _TRIAL)), end + _CHOICE.size
        value = TopologyVersion(version, step, issuer, bool(flags & _AUTO), self._edges(data, end), hub)
        if value != self.first and (issuer not in self.place or not (version or value.auto or flags & _CHOSEN)):
            raise FrameError(f"TOPOLOGY {version}.{step} issued by {issuer[:16]!r}")
        return value

    def to_file(self, value: TopologyVersion) -> bytes:
        """Return the bytes that keep a value through restarts."""
        body = _MAGIC + self.encode(value)
        return body + _CHECK.pack(zlib.crc32(body))

    def from_file(self, data: bytes) -> TopologyVersion | None:
        """Return the value that was kept; None where it belongs to another configuration. Raises `FrameError`."""
        body = data[: -_CHECK.size]
        if not body.startswith(_MAGIC) or _CHECK.pack(zlib.crc32(body)) != data[-_CHECK.size :]:
            raise FrameError("the file is damaged")
        return self.decode(body[len(_MAGIC) :])

    def _hub(self, data: bytes, at: int, *, trial: bool) -> Hub:
        if len(data) < at + _CHOICE.size:
            raise FrameError(f"TOPOLOGY of {len(data)} bytes ends too early")
        place, before, round_trip = _CHOICE.unpack_from(data, at)
        hub = Hub(place, before, round_trip, trial)
        if hub == Hub() or not max(hub.place, hub.before) < len(self.names):
            raise FrameError(f"TOPOLOGY: hub {hub.place} after {hub.before}")
        return hub

    def _edges(self, data: bytes, at: int) -> tuple[Edge, ...]:
        names, edges = self.names, []
        for place, name in enumerate(names):
            if at >= len(data):
                raise FrameError(f"TOPOLOGY of {len(data)} bytes ends too early")
            row = range(at + 1, at + 1 + _INDEX.size * data[at], _INDEX.size)
            at = row.stop
            if at > len(data):
                raise FrameError(f"TOPOLOGY of {len(data)} bytes ends too early")
            before = place
            for offset in row:
                (other,) = _INDEX.unpack_from(data, offset)
                if not before < other < len(names):
                    raise FrameError(f"TOPOLOGY: robot {place} is linked with robot {other}, in this order")
                edges.append((name, names[other]))
                before = other
        if at != len(data):
            raise FrameError(f"TOPOLOGY of {len(data)} bytes: {len(data) - at} too many")
        if tuple(edges) == self.first.edges:
            return self.first.edges  # a configuration may have more links than a radio holds
        try:
            graph = Graph(names, edges)
            _check(graph)
        except LocalError as error:
            raise FrameError(f"TOPOLOGY: {error}") from None
        return graph.edges


def _check(graph: Graph) -> None:
    for name in graph.names:
        if graph.degree(name) > MAX_LINKS:
            raise LocalError(f"{name} would have {graph.degree(name)} links, a robot has at most {MAX_LINKS}")


# -- which links there are ------------------------------------------------------------------------------------


class Advertisement(NamedTuple):
    """A robot's report of its own links (LSA)."""

    neighbours: dict[str, int]
    """One-way time to each, in units of 0.1 ms."""
    leaving: bool = False
    topology: int = 0
    """The tag (u32) of the topology that holds there; 0 = the configuration's own."""
    heard: int = 0
    """The robots it has reached by calling them, with the automatic topology: bit i = robot i of the configuration."""
    process: int = 0
    """Number of the mesh process that tells this, u32: the low half of the incarnation in its HELLO. 0: not told."""
    twins: tuple[str, ...] = ()
    """Names that two robots have, as far as this robot has seen it itself; at most `MAX_TWINS`, sorted."""


def encode_advertisement(packet: Advertisement) -> bytes:
    """Return the payload of a flooded LSA."""
    names = b"".join(packed(name) + _METRIC.pack(time) for name, time in sorted(packet.neighbours.items()))
    heard = packet.heard.to_bytes((packet.heard.bit_length() + 7) // 8, "little")
    twins = packet.twins[:MAX_TWINS]
    flags = (
        packet.leaving | bool(packet.topology) << 1 | bool(heard) << 2 | bool(packet.process) << 3 | bool(twins) << 4
    )
    tail = (_U32.pack(packet.topology) if packet.topology else b"") + (bytes((len(heard),)) + heard if heard else b"")
    tail += _U32.pack(packet.process) if packet.process else b""
    tail += bytes((len(twins),)) + b"".join(map(packed, twins)) if twins else b""
    return _LSA.pack(flags, len(packet.neighbours)) + names + tail


def decode_advertisement(data: bytes) -> Advertisement:
    """Decode the payload of a flooded LSA. Most only repeat what is known: small ones are not taken apart again."""
    return _decode_small_advertisement(data) if len(data) <= _SMALL else _decode_advertisement(data)


def _decode_advertisement(data: bytes) -> Advertisement:
    reader = PacketReader(data)
    flags, count = reader.unpack(_LSA)
    if flags > 31:
        raise FrameError(f"LSA flags {flags:#x}: bits 0 to 4 are known")
    neighbours: dict[str, int] = {}
    for _ in range(count):
        name = reader.name()
        (neighbours[name],) = reader.unpack(_METRIC)
    topology = reader.unpack(_U32)[0] if flags & 2 else 0
    heard = int.from_bytes(reader.octets(), "little") if flags & 4 else 0
    process = reader.unpack(_U32)[0] if flags & 8 else 0
    count = reader.unpack(_COUNT)[0] if flags & 16 else 0
    if count > MAX_TWINS:
        raise FrameError(f"LSA with {count} names of two robots: at most {MAX_TWINS}")
    twins = tuple(reader.name() for _ in range(count))
    reader.end()
    return Advertisement(neighbours, bool(flags & 1), topology, heard, process, twins)


_decode_small_advertisement = lru_cache(maxsize=1024)(_decode_advertisement)


# -- ways -----------------------------------------------------------------------------------------------------


class Route(NamedTuple):
    """The way from this robot to another one."""

    next_hop: str
    hops: int
    cost: int
    """Sum of the edges' metric."""
    time: int
    """Sum of the edges' one-way times, units of 0.1 ms."""


class Weight(NamedTuple):
    """One direction of a link."""

    cost: int
    time: int


def routes(me: str, graph: Mapping[str, Mapping[str, Weight]]) -> dict[str, Route]:
    """Return the best route to every robot that can be reached; `graph[a][b]` is the edge from a to b.

    Of ways that cost the same the one with fewer hops wins, then the one whose first robot has the lower name: the
    same graph gives the same routes everywhere and every time.
    """
    found: dict[str, Route] = {}
    # Every name at most once for each edge that leads to it.
    heap = [(edge.cost, 1, peer, peer, edge.time) for peer, edge in graph.get(me, {}).items()]
    heapq.heapify(heap)
    while heap:
        cost, hops, first, name, time = heapq.heappop(heap)
        if name in found or name == me:
            continue
        found[name] = Route(first, hops, cost, time)
        for peer, edge in graph.get(name, {}).items():
            if peer not in found and peer != me:
                heapq.heappush(heap, (cost + edge.cost, hops + 1, first, peer, time + edge.time))
    return found


def routes_by_hops(me: str, own: Mapping[str, int], told: Mapping[str, Mapping[str, int]]) -> dict[str, Route]:
    """Return the same where every edge costs 1, level by level. `own`: times of this robot's edges; `told[a][b]`: the
    time that a tells of its edge to b, which counts where b tells of it, too."""
    found: dict[str, Route] = {}
    nothing: Mapping[str, int] = {}
    level = {peer: (peer, time) for peer, time in own.items()}
    hops = 0
    while level:
        hops += 1
        # In the order in which `routes` finds them.
        for first, name, time in sorted([(first, name, time) for name, (first, time) in level.items()]):
            found[name] = Route(first, hops, hops, time)
        further: dict[str, tuple[str, int]] = {}
        for name, (first, time) in level.items():
            for peer, there in told.get(name, nothing).items():
                if peer in found or peer == me:
                    continue
                back = told.get(peer, nothing).get(name)
                if back is None:
                    continue
                way = (first, time + (there if there > back else back))
                best = further.get(peer)
                if best is None or way < best:
                    further[peer] = way
        level = further
    return found
