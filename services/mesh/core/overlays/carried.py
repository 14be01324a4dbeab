"""The messages between neighbours of a topology whose links are not those of the radio (`routing.physical_links`).

A value leaves once over each link, in a CARRY packet that names the robots it is for. A robot that receives the packet
delivers the value if it is named, and hands it on to the other named robots by its own routes, but never back. No robot
acknowledges, repeats or keeps a value. So a value may be lost with a link, and lockstep then asks for it again.

A robot accepts a value only from the neighbour with which its own route to the value's origin begins. So a robot at the
end of a tree cannot forge values of others. A robot on the way could.
"""

import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import NamedTuple

from services.mesh.core.actions import Emit, Transmit
from services.mesh.core.overlays.unicast import ttl_of
from services.mesh.core.routing.automatic_topology import place_of, places
from services.mesh.core.routing.topology import Route
from services.mesh.core.wire import frames
from swarm.errors import FrameError
from swarm.messages.keys import owner_of, parse

CARRY = 8
"""Kind of packets on unicast channels, besides those of `wire.packets` and `bulk.pieces`. Such a channel is bound to
the key that its values have."""

COUNTERS = ("carried", "carried_expired", "carried_no_route", "carried_refused")

_HEAD = struct.Struct("<BBBB")


class Carried(NamedTuple):
    """A value on its way. Its origin is the robot that its channel's key belongs to."""

    robots: int
    """The robots on this way that it is for: bit i is robot i of all names, sorted."""
    payload: bytes
    ttl: int
    """Hops that it may take."""
    latest: bool = False
    """Whether a newer value of this key may take its place while it waits."""


def encode_carried(packet: Carried) -> bytes:
    """Encode a CARRY packet."""
    bits = packet.robots.to_bytes((packet.robots.bit_length() + 7) // 8, "little")
    return _HEAD.pack(CARRY, packet.latest, packet.ttl, len(bits)) + bits + packet.payload


def decode_carried(data: bytes) -> Carried:
    """Decode a CARRY packet. Raises `FrameError`."""
    if len(data) < _HEAD.size:
        raise FrameError(f"CARRY of {len(data)} bytes: it has at least {_HEAD.size}")
    kind, flags, ttl, size = _HEAD.unpack_from(data)
    end = _HEAD.size + size
    if kind != CARRY or flags > 1 or len(data) < end:
        raise FrameError(f"CARRY kind {kind}, flags {flags:#x}, {len(data)} bytes where {end} are the least")
    return Carried(int.from_bytes(data[_HEAD.size : end], "little"), data[end:], ttl, bool(flags))


def limit_of(priority: int, robots: Collection[str]) -> int:
    """Return the number of bytes that a carried value of a class may have, in a swarm of these robots."""
    return frames.largest(priority, frames.MAX_PAYLOAD) - _HEAD.size - (len(robots) + 7) // 8


class Carrier:
    """The carried values of one robot."""

    def __init__(
        self,
        me: str,
        names: Sequence[str],
        *,
        emit: Emit,
        route: Callable[[str], Route | None],
        admits: Callable[[str, str], bool],
        passes: Callable[[str], bool],
        deliver: Callable[[str, bytes, int], None],
        counters: Counter[str],
    ) -> None:
        """`names`: all robots, in the same order everywhere. `admits(origin, key)` says whether a key may appear on the
        own bus, `passes(key)` whether one may be handed on at all."""
        self._me = me
        self._names = names
        self._place = place_of(tuple(names))
        self._emit = emit
        self._route = route
        self._admits = admits
        self._passes = passes
        self._deliver = deliver
        self._counters = counters

    def admits(self, key: str) -> bool:
        """Return whether a neighbour may bind a channel of carried values to this key."""
        robot = owner_of(key)
        return robot != self._me and robot in self._place and self._passes(key)

    def send(self, key: str, payload: bytes, priority: int, robots: Iterable[str], *, latest: bool) -> None:
        """Send an own value to robots. A robot that cannot be reached is left out, and counted."""
        self._hand_on(key, payload, priority, robots, latest=latest)

    def receive(self, peer: str, key: str, data: bytes, priority: int) -> None:
        """Take a CARRY packet of a neighbour. Raises `FrameError`."""
        packet = decode_carried(data)
        origin = parse(key).robot
        back = self._route(origin)
        if back is None or back.next_hop != peer:
            self._counters["carried_refused"] += 1
            return
        robots = [self._names[place] for place in places(packet.robots, len(self._names))]
        if self._me in robots:
            robots.remove(self._me)
            if self._admits(origin, key):
                self._deliver(key, packet.payload, priority)
            else:
                self._counters["carried_refused"] += 1
        if not robots:
            return
        if packet.ttl <= 1:
            self._counters["carried_expired"] += 1
            return
        self._counters["carried"] += 1
        self._hand_on(key, packet.payload, priority, robots, latest=packet.latest, ttl=packet.ttl - 1, source=peer)

    def _hand_on(
        self,
        key: str,
        payload: bytes,
        priority: int,
        robots: Iterable[str],
        *,
        latest: bool,
        ttl: int = 0,
        source: str | None = None,
    ) -> None:
        """Send a packet over each link with which a robot's route begins; `ttl` 0 stands for the longest route."""
        ways: dict[str, tuple[int, int]] = {}
        for robot in robots:
            route = self._route(robot)
            if route is None or route.next_hop == source:
                self._counters["carried_no_route"] += 1
                continue
            bits, hops = ways.get(route.next_hop, (0, ttl))
            ways[route.next_hop] = bits | 1 << self._place[robot], ttl or max(hops, ttl_of(route))
        for hop, (bits, hops) in ways.items():
            data = encode_carried(Carried(bits, payload, hops, latest))
            self._emit(Transmit(hop, frames.UNICAST, key, data, priority, latest))
