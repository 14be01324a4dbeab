"""Around a silent link: what a robot says to a neighbour goes over others while the link between them carries nothing.

A link that a wall or a passer-by cuts is given up after seconds only; until then unicast takes it, too. Whoever needs
its neighbour's word sooner (`swarm.core.lockstep`) sends it around: along the shortest way without the link between
sender and receiver. Each robot on the way looks for that way in its own map, the same one everywhere. Nobody
acknowledges and nobody repeats but who needs it: a question is asked again.
"""

import struct
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from services.mesh.core.actions import Emit, Transmit
from services.mesh.core.overlays.unicast import ttl_of
from services.mesh.core.routing.shortest_paths import Route
from services.mesh.core.wire.frames import MAX_PAYLOAD, UNICAST
from services.mesh.core.wire.texts import Reader, packed
from swarm.errors import FrameError
from swarm.messages.keys import key as key_of

AROUND = 8
"""Kind of the packet on unicast channels, besides those in `packets` and `pieces`."""

_HEAD = struct.Struct("<BB")

MAX_MESSAGE = MAX_PAYLOAD - _HEAD.size - 2 * 17 - 256
"""Longest payload, in bytes, whatever its names and key."""

COUNTERS = ("around_forwarded", "around_no_way", "around_refused", "around_sent")


class Packet(NamedTuple):
    """A message on its way."""

    sender: str
    to: str
    key: str
    payload: bytes
    ttl: int


def encode(packet: Packet) -> bytes:
    """An AROUND packet."""
    head = _HEAD.pack(AROUND, packet.ttl)
    return head + packed(packet.sender) + packed(packet.to) + packed(packet.key, 255) + packet.payload


def decode(data: bytes) -> Packet:
    """An AROUND packet; raises `FrameError`."""
    if len(data) < _HEAD.size:
        raise FrameError(f"AROUND of {len(data)} bytes: it has at least {_HEAD.size}")
    kind, ttl = _HEAD.unpack_from(data)
    if kind != AROUND:
        raise FrameError(f"packet kind {kind}: AROUND is {AROUND}")
    reader = Reader(data, _HEAD.size)
    sender, to, key = reader.name(), reader.name(), reader.key()
    return Packet(sender, to, key, data[reader.at :], ttl)


class Around:
    """This robot's part in it."""

    def __init__(
        self,
        me: str,
        robots: frozenset[str],
        *,
        emit: Emit,
        route: Callable[[str, str], Route | None],
        admits: Callable[[str, str], bool],
        deliver: Callable[[str, bytes, int], None],
        counters: Counter[str],
    ) -> None:
        """`route(sender, to)` is the way to `to` without the link between the two; `admits(sender, key)` says what may
        come in."""
        self._me = me
        self._robots = robots
        self._emit = emit
        self._route = route
        self._admits = admits
        self._deliver = deliver
        self._counters = counters
        self._channel = key_of(me, "mesh", "unicast")

    def send(self, to: str, key: str, payload: bytes, priority: int) -> None:
        """Say it to a neighbour, once; counted and dropped where there is no way."""
        if (route := self._route(self._me, to)) is None:
            self._counters["around_no_way"] += 1
            return
        self._counters["around_sent"] += 1
        self._pass_on(Packet(self._me, to, key, payload, ttl_of(route)), route, priority)

    def receive(self, data: bytes, priority: int) -> None:
        """A packet of a neighbour, perhaps another one's; raises `FrameError`."""
        packet = decode(data)
        if not {packet.sender, packet.to} <= self._robots:
            raise FrameError(f"AROUND from {packet.sender} to {packet.to}: one is not in our configuration")
        if packet.to == self._me:
            if self._admits(packet.sender, packet.key):
                self._deliver(packet.key, packet.payload, priority)
            else:
                self._counters["around_refused"] += 1
        elif packet.ttl <= 1 or packet.sender == self._me or (route := self._route(packet.sender, packet.to)) is None:
            self._counters["around_no_way"] += 1
        else:
            self._counters["around_forwarded"] += 1
            self._pass_on(packet._replace(ttl=packet.ttl - 1), route, priority)

    def _pass_on(self, packet: Packet, route: Route, priority: int) -> None:
        self._emit(Transmit(route.next_hop, UNICAST, self._channel, encode(packet), priority))
