"""The way in which every robot learns that all have a flood (`announce`): who has it is told over all links, both ways
at once.

    r0 --SPREAD {r0}--> r1 --SPREAD {r0, r1}--> r2      the last robot knows when the flood is there,
       <--KNOWN {all}--    <----KNOWN {all}----         the others when its word comes back

Each SPREAD names the robots that its sender knows to have the message. A robot tells a neighbour whom it knows of, in
one KNOWN, as soon as that includes every robot that has a shortest way to that neighbour over this one. On a tree
these are all robots but those behind the neighbour, so completion travels both ways at once.

On other graphs robots could wait for one another in a circle. So over the links of one tree of shortest ways to the
origin a robot also tells its parent when it knows of all robots behind itself, and it tells a child when it knows of
all robots but those behind the child. Two KNOWN go up such a link, one goes down beside the SPREAD, and one goes each
way over any other link beside the two SPREAD: at most 4E messages for E links.

Ways are those of the map. Where they change meanwhile, and after a second try, who knows of all tells each neighbour
that may not.

A robot waits for those that it had a way to when the flood came. Where some of them are gone, the origin decides, after
its second try or before, that those who are left are all: this word (`final`) goes over all links.
"""

import struct
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from services.mesh.core.actions import Emit, Transmit
from services.mesh.core.overlays.echo import LIFE, MAX_WAVES, FloodId
from services.mesh.core.routing.automatic_topology import place_of
from services.mesh.core.wire.frames import FLOOD
from services.mesh.core.wire.packets import KNOWN, PacketReader, packed_bits
from swarm.core.graph import hops_from
from swarm.errors import FrameError

_KNOWN = struct.Struct("<BBQI")


class Known(NamedTuple):
    """The robots that have a flood, as far as the sender knows."""

    incarnation: int
    sequence: int
    """The sequence number of its first try."""
    robots: int
    """Bit i is robot i of all names, sorted."""
    final: bool = False
    """The origin's word that these are all that can be reached."""


def encode_known(packet: Known) -> bytes:
    """Encode a KNOWN packet."""
    return _KNOWN.pack(KNOWN, packet.final, packet.incarnation, packet.sequence) + packed_bits(packet.robots)


def decode_known(data: bytes) -> Known:
    """Decode a KNOWN packet. Raises `FrameError`."""
    reader = PacketReader(data)
    kind, flags, incarnation, sequence = reader.unpack(_KNOWN)
    if kind != KNOWN or flags > 1:
        raise FrameError(f"KNOWN kind {kind}, flags {flags:#x}: bit 0 is known")
    robots = int.from_bytes(reader.octets(), "little")
    reader.end()
    return Known(incarnation, sequence, robots, bool(flags))


@dataclass(eq=False)
class _Flood:
    """One flood of which all are to know. Sets of robots are bits: bit i is robot i of all names, sorted."""

    key: str
    priority: int
    goal: int
    """The robots in reach when it came here: a robot that joins later is not waited for."""
    ends: float
    """The time at which it is forgotten."""
    robots: int = 0
    """The robots that have it, as far as is known here."""
    shared: dict[str, int] = field(default_factory=dict)
    """The robots of which each neighbour has told us, or has been told."""
    disturbed: bool = False
    complete: bool = False
    """Whether that was told here."""
    final: set[str] | None = None
    """Neighbours that have said or been told the origin's word; None without it."""


class Completion:
    """The floods in progress of which all robots are to learn that all have them."""

    def __init__(
        self,
        me: str,
        names: Sequence[str],
        *,
        emit: Emit,
        links: Collection[str],
        expected: Callable[[], Collection[str]],
        graph: Callable[[], Mapping[str, Collection[str]]],
        complete: Callable[[FloodId, str, float], None],
    ) -> None:
        """`names` of all robots, sorted. `links` are the neighbours, as they are at any time; `expected()` the robots
        that there is a way to; `graph()` all links. `complete(id, key, now)` is called once, when all have a flood."""
        self._me = me
        self._names = names
        self._place = place_of(tuple(names))
        self._emit = emit
        self._links = links
        self._expected = expected
        self._graph = graph
        self._complete = complete
        self._floods: OrderedDict[FloodId, _Flood] = OrderedDict()
        self._map: dict[str, frozenset[str]] = {}
        self._through: dict[tuple[str, str], tuple[int, ...]] = {}
        """For each origin and neighbour, the robots of which this robot tells that neighbour; made as needed."""

    def __len__(self) -> int:
        return len(self._floods)

    def reached(
        self, id: FloodId, key: str, priority: int, peer: str, robots: int, now: float, *, has: bool, life: float = 0.0
    ) -> int:
        """A try of a flood has come from `peer`, the first copy of it; from nobody where it is our own. `has`: whether
        the message is here, too, otherwise `came` will say so. Returns whom our own SPREAD is to name. Raises
        `FrameError` where `robots` has strangers."""
        self._check(robots)
        flood = self._floods.get(id)
        if flood is None:
            if not self._floods:
                self._look_at_map()
            if len(self._floods) >= MAX_WAVES:
                self._floods.popitem(last=False)
            goal = self._bits((self._me, *self._expected()))
            flood = self._floods[id] = _Flood(key, priority, goal, now + LIFE + life)
        else:
            flood.shared.clear()  # it is a second try: what was told may be lost
            flood.disturbed = True
        flood.robots |= robots | self._bits((self._me,) if has else ())
        if peer:
            flood.shared[peer] = robots
        return flood.robots

    def spread(self, id: FloodId, peers: Iterable[str], now: float) -> None:
        """Note that SPREAD has left for these neighbours."""
        flood = self._floods[id]
        for peer in peers:
            flood.shared[peer] = flood.shared.get(peer, 0) | flood.robots
        self._settle(id, flood, now)

    def came(self, id: FloodId, now: float) -> None:
        """The message that a flood has announced is here."""
        flood = self._floods.get(id)
        if flood is not None:
            flood.robots |= self._bits((self._me,))
            self._settle(id, flood, now)

    def heard(self, id: FloodId, peer: str, robots: int, now: float, *, final: bool = False) -> None:
        """Note that a neighbour knows of these robots. Raises `FrameError` where there are strangers."""
        self._check(robots)
        flood = self._floods.get(id)
        if flood is not None:
            flood.robots |= robots
            flood.shared[peer] = flood.shared.get(peer, 0) | robots
            if final:
                flood.final = (flood.final or set()) | {peer}
            self._settle(id, flood, now)

    def end(self, id: FloodId, now: float) -> None:
        """Our own flood is over: those who are left have it, and are to know."""
        flood = self._floods.get(id)
        if flood is not None and not flood.complete:
            flood.complete, flood.final = True, set()
            self._settle(id, flood, now)

    def unlink(self, peer: str) -> None:
        """Remove a neighbour that is gone: what was told it last may be lost."""
        for flood in self._floods.values():
            flood.shared.pop(peer, None)

    def ways_changed(self, now: float) -> None:
        """The map may be another one."""
        if self._floods and self._look_at_map():
            for id, flood in tuple(self._floods.items()):
                flood.disturbed = True
                self._settle(id, flood, now)

    def robots(self, id: FloodId) -> list[str]:
        """Return the robots that are known to have it."""
        flood = self._floods.get(id)
        return [] if flood is None else [name for i, name in enumerate(self._names) if flood.robots >> i & 1]

    def handle_timer(self, now: float) -> None:
        """Forget what is old; cheap enough to be called at any time."""
        while self._floods:
            id, flood = next(iter(self._floods.items()))
            if flood.ends > now:
                return
            del self._floods[id]

    # -- inside ------------------------------------------------------------------------------------------------

    def _settle(self, id: FloodId, flood: _Flood, now: float) -> None:
        """Tell each neighbour that waits for our word what is known, if that is all that we are to know."""
        complete = not flood.goal & ~flood.robots
        for peer in self._links:
            shared = flood.shared.get(peer, 0)
            wanted = (flood.goal,) if complete and flood.disturbed else self._told_by_us(id.origin, peer)
            told = (each & flood.goal for each in wanted)
            if any(not needs & ~flood.robots and needs & ~shared for needs in told):
                self._tell(id, flood, peer)
            elif flood.final is not None and peer not in flood.final:
                flood.final.add(peer)
                self._tell(id, flood, peer, final=True)
        if (complete or flood.final is not None) and not flood.complete:
            flood.complete = True
            self._complete(id, flood.key, now)

    def _tell(self, id: FloodId, flood: _Flood, peer: str, *, final: bool = False) -> None:
        flood.shared[peer] = flood.shared.get(peer, 0) | flood.robots
        data = encode_known(Known(id.incarnation, id.sequence, flood.robots, final))
        self._emit(Transmit(peer, FLOOD, flood.key, data, flood.priority))

    def _look_at_map(self) -> bool:
        """Return whether links are others than at the last look. Times that changed do not matter."""
        links = {name: frozenset(peers) for name, peers in self._graph().items()}
        if links == self._map:
            return False
        self._map = links
        self._through.clear()
        return True

    def _told_by_us(self, origin: str, peer: str) -> tuple[int, ...]:
        """Return the sets of robots, each of which we tell a neighbour when we know all of it: those with a shortest
        way to it over us. Over a link of the tree to our parent also those on our side, to a child only those."""
        if (origin, peer) not in self._through:
            ours, theirs = hops_from(self._map, self._me), hops_from(self._map, peer)
            told = {self._bits((self._me, *(name for name, hops in ours.items() if theirs.get(name) == hops + 1)))}
            tree = _tree(self._map, origin)
            if peer in tree.get(self._me, ()):
                rest = {name: peers - {peer} if name == self._me else peers for name, peers in tree.items()}
                side = hops_from(rest, self._me)
                own_side = {self._bits(side)}
                # Towards a child, the robots with a shortest way to it over us are all on our side.
                told = own_side if origin in side else told | own_side
            self._through[origin, peer] = tuple(told)
        return self._through[origin, peer]

    def _bits(self, robots: Iterable[str]) -> int:
        bits = 0
        for robot in robots:
            bits |= 1 << self._place[robot]
        return bits

    def _check(self, robots: int) -> None:
        if robots >> len(self._names):
            raise FrameError("a flood with robots that are not in our configuration")


def _tree(graph: Mapping[str, Collection[str]], origin: str) -> dict[str, set[str]]:
    """Return the neighbours of each robot in the tree of shortest ways to the origin; the first way by name where there
    are several."""
    hops = hops_from(graph, origin)
    tree: dict[str, set[str]] = {name: set() for name in hops}
    for name in hops:
        nearer = [
            peer for peer in graph.get(name, ()) if hops.get(peer) == hops[name] - 1 and name in graph.get(peer, ())
        ]
        if nearer:
            tree[name].add(min(nearer))
            tree[min(nearer)].add(name)
    return tree
