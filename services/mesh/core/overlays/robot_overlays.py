"""The overlays of one robot, joined: flood, unicast, link state, membership and the stop register.

The node feeds it links and packets, and carries out `actions()`. It knows no sessions, so the same code runs between
real links and, by the thousand, in virtual time (tests/services/mesh/overlay_world.py).
"""

from collections import Counter
from collections.abc import Callable, Collection, Mapping
from functools import lru_cache

from services.mesh.core.actions import LinkAction, Transmit, WriteStops
from services.mesh.core.bulk import exchange, transfers
from services.mesh.core.link import Received
from services.mesh.core.overlays import carried, flood, flood_store, large_messages, unicast
from services.mesh.core.overlays.carried import CARRY, Carrier
from services.mesh.core.overlays.flood import FloodOverlay
from services.mesh.core.overlays.members import MembersWatch
from services.mesh.core.overlays.requests import OverlayRequests, Request
from services.mesh.core.overlays.stop import Halt, Register, Stops
from services.mesh.core.overlays.unicast import Unicast
from services.mesh.core.relay import Admission
from services.mesh.core.routing.link_state import HOPS, AdvertisedLinks, LinkStateMap
from services.mesh.core.routing.membership import Clashes, Membership, Survey
from services.mesh.core.routing.wanted_links import InitialLinks, Linking
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import CONTROL, FLOOD, MAX_PAYLOAD
from swarm.errors import FrameError, PayloadError
from swarm.messages import Members, MeshGraph, Stop, Stopped, Topology
from swarm.messages.keys import key as key_of
from swarm.messages.keys import parse

COUNTERS = (*carried.COUNTERS, *flood.COUNTERS, *flood_store.COUNTERS, *large_messages.COUNTERS, *unicast.COUNTERS,
            *transfers.COUNTERS, *exchange.COUNTERS, "bad_packets", "topology_foreign")  # fmt: skip

_NEVER = float("inf")

Action = Transmit | Received | LinkAction | WriteStops
"""What the overlays ask of their node."""


class RobotOverlays:
    """Calls with `now` must not go back in time; no call may overlap another."""

    def __init__(
        self,
        me: str,
        robots: Collection[str],
        *,
        incarnation: int,
        random: Callable[[], float],
        counters: Counter[str],
        metric: str = HOPS,
        process: int = 0,
        start: InitialLinks | None = None,
        admits_flood: Callable[[str], bool] = lambda key: False,
        admits_unicast: Callable[[str, str], bool] = lambda sender, key: False,
        admits_neighbour: Callable[[str, str], bool] = lambda sender, key: False,
        carries: Callable[[str], bool] = lambda key: False,
        wanted: Callable[[str], bool] = lambda key: True,
    ) -> None:
        """`incarnation` is higher than at the last start (a time in us); `random` gives numbers from 0 up to 1.
        `process` is the number of this mesh process in HELLO, 0 where there are no HELLOs. `start` is where the
        topology begins; without it links are the caller's matter. `admits_flood(key)`, `admits_unicast(sender, key)`:
        which keys the relay rules let in. `wanted(key)`: whether anybody hears a key on the own bus, if known."""
        self.me = me
        self._robots = frozenset(robots)  # the very same, if it is one already: simulations share it
        if me not in self._robots:
            self._robots |= {me}
        self._counters = counters
        counters.update(dict.fromkeys(COUNTERS, 0))
        self._admission = Admission(me, self._robots, admits_flood, admits_unicast)
        self._actions: list[Action] = []
        emit = self._actions.append
        self._requests = OverlayRequests(me, to_bus=self._to_bus, now=lambda: self.now)
        names = _sorted(self._robots)
        self._flood = FloodOverlay(
            me,
            incarnation,
            self._robots,
            names,
            emit=emit,
            deliver=self._on_flood,
            reached=self._requests.reached,
            all_have=self._requests.all_have,
            towards=self._towards,
            expected=lambda: self._map.routes().keys(),
            random=random,
            counters=counters,
            graph=lambda: self._map.graph(),  # noqa: PLW0108 - the map comes later
        )
        self._map = LinkStateMap(
            me,
            self._robots,
            metric=metric,
            publish=self._publish_links,
            aged=self._flood.store.forget,
            returned=self._flood.store.take_again,
            random=random,
            process=process,
        )
        self.clashes = Clashes(me, self._robots, self._map)
        self._unicast = Unicast(
            me,
            incarnation,
            self._robots,
            emit=emit,
            route=self._map.route,
            admits=self._admission.accepts,
            deliver=self._to_bus,
            ended=self._requests.sent,
            passed=self._requests.passed,
            counters=counters,
        )
        self._requests.flood = self._flood
        self._requests.unicast = self._unicast
        self._requests.routes = self._map.routes
        self._large = large_messages.Large(
            me,
            self._unicast.transfers,
            self._flood.large,
            emit=self._unicast.carry,
            neighbours=self._map.neighbours,
            counters=counters,
        )
        self._unicast.on_large = self._large.receive
        self._register = Register(
            me, lambda: self._flood.incarnation, self._robots, emit=emit, changed=self._stops_changed
        )
        self._stops = Stops(me, self._register, self._flood, self._to_bus)
        self._carrier = Carrier(
            me,
            names,
            emit=emit,
            route=self._map.route,
            admits=admits_neighbour,
            passes=carries,
            deliver=self._to_bus,
            counters=counters,
        )
        membership = Membership(me, names, self._map.routes)
        self._survey = Survey(me, names, membership, self._map, self._flood.known)
        self._members = MembersWatch(
            me, names, membership, self._map, self._flood.known, to_bus=self._to_bus, wanted=wanted
        )
        self.now = 0.0
        """The time of the last call."""
        self._random = random
        self._version = 0
        self._deadline = 0.0
        self._lsa_key = key_of(me, "mesh", "lsa")
        self.linking: Linking | None = None
        """Decides which links there are to be; None where the caller does."""
        if start is not None:
            self.linking = Linking(me, start, self._map, act=emit, random=random, counters=counters)
            self._requests.linking = self.linking

    # -- links and packets -------------------------------------------------------------------------------------

    def link_up(self, peer: str, now: float) -> bool:
        """Take a new link; False where this robot has no use for it and is to close it."""
        self.now = now
        if self.linking is not None and not self.linking.link_up(peer, now):
            return False
        self._register.link_up(peer)
        news = self._map.link_up(peer, now)
        self._flood.link_up(peer, now)
        self._routes_changed(now, look=news)
        return True

    def settle(self, links: Mapping[str, Mapping[str, int]], known: dict[str, AdvertisedLinks], now: float) -> None:
        """Begin in a swarm that has been there for long, with the links of all its robots, see `LinkStateMap.settle`.
        Both tables may be the same for all robots: none of them changes one."""
        self.now = now
        self._map.settle(links[self.me], known, now)
        self._version = self._map.version
        self._members.settle(links, now, self._random())

    def link_down(self, peer: str, now: float) -> None:
        """Take the end of a link."""
        self.now = now
        self._register.link_down(peer)
        self._flood.unlink(peer)
        # First the map, so that the next two find the other way, and others hear of it before what takes that way.
        self._map.link_down(peer, now)
        self._flood.link_down(peer, now)
        self._unicast.link_down(peer, now)
        self._routes_changed(now)
        if self.linking is not None:
            self.linking.link_down(peer, now)

    def dial_failed(self, peer: str, reason: str, now: float) -> None:
        """Note that a robot that was called does not answer."""
        self.now = now
        if self.linking is not None:
            self.linking.dial_failed(peer, reason, now)

    def tell_clashes(self, now: float) -> None:
        """Have the link state name the robots of which this one has seen two."""
        self.now = now
        self._map.tell_twins(tuple(sorted(self.clashes.own(now))), now)

    def measured(self, peer: str, rtt: float, now: float) -> None:
        """Take the smoothed round-trip time of a link, s."""
        self.now = now
        self._map.measured(peer, rtt, now)

    def admits(self, peer: str, overlay: int, key: str) -> bool:
        """Return whether a neighbour may bind a channel of flood or unicast to this key."""
        if self._admission.binds(peer, overlay, key):
            return True
        carried = overlay != FLOOD and self.linking is not None and self.linking.carried
        return carried and self._carrier.admits(key)

    def receive(self, peer: str, overlay: int, key: str, data: bytes, priority: int, now: float) -> None:
        """Take a packet of a neighbour on an admitted channel. A damaged packet is dropped and counted: its sender
        may be far away, and innocent links must not break for it."""
        self.now = now
        if len(data) > MAX_PAYLOAD and data[0] != (packets.TOPOLOGY if overlay == FLOOD else CARRY):
            # It came in fragments. Where a number of packets is kept, each of these would hold up to a megabyte.
            self._counters["bad_packets"] += 1
            return
        try:
            kind = packets.kind_of(data)
            if overlay != FLOOD and kind == CARRY:
                self._carrier.receive(peer, key, data, priority)
            elif overlay != FLOOD:
                self._unicast.receive(peer, data, priority, now)
            elif kind == packets.HALT:
                self._register.receive(peer, data, now)
            elif kind == packets.TOPOLOGY and self.linking is not None:
                self.linking.receive(peer, data, now)
            else:
                self._flood.receive(peer, key, data, priority, now)
        except (FrameError, PayloadError):
            self._counters["bad_packets"] += 1
        if self._version != self._map.version:
            self._routes_changed(now)

    def pushed_back(self, packet: Transmit) -> None:
        """The queue of a link has refused a packet. Unicast repeats end to end; a flood is offered again from here."""
        if packet.overlay == FLOOD:
            self._flood.pushed_back(packet, self.now)
            self._deadline = min(self._deadline, self._flood.next_deadline())

    # -- what this robot wants ---------------------------------------------------------------------------------

    def flood(self, key: str, payload: bytes, priority: int, now: float, *, latest: bool) -> None:
        """Carry a value of an own key to all robots, as a relay rule says."""
        self.now = now
        if key == self._lsa_key:
            return  # nobody's business but the map's, whatever a rule with ** says
        self._flood.publish(key, payload, priority, now, latest=latest)

    def carry(self, key: str, payload: bytes, priority: int, to: Collection[str], now: float, *, latest: bool) -> None:
        """Carry a value to neighbours whom links of others lead to, as a relay rule says."""
        self.now = now
        self._carrier.send(key, payload, priority, to, latest=latest)

    def send(
        self, to: str, key: str, payload: bytes, priority: int, now: float, *, latest: bool, avoid_link: bool = False
    ) -> None:
        """Carry a value to one robot, as a relay rule says; with `avoid_link` once, and not over the link with it."""
        self.now = now
        if avoid_link:
            self._unicast.send_once(to, key, payload, priority)
        else:
            self._unicast.send(None, to, key, payload, priority, now, latest=latest)

    def request(self, request: Request, now: float) -> None:
        """Take a request of an app; the answer goes to the own bus."""
        self.now = now
        self._requests.take(request)

    def stop(self, stop: Stop, now: float) -> None:
        """Somebody on this robot has published `swarm/stop`."""
        self.now = now
        self._register.stop(stop.reason, now)

    def arm(self, now: float, age: float = 0.0) -> None:
        """Somebody on this robot takes back the stops, by a command that was given first `age` seconds ago."""
        self.now = now
        self._register.arm(now, age)

    def leave(self, now: float) -> None:
        """This robot's mesh stops."""
        self.now = now
        self._map.leave(now)

    # -- time and outputs --------------------------------------------------------------------------------------

    def handle_timer(self, now: float) -> None:
        """Do everything that is due at `now`."""
        self.now = now
        self._map.handle_timer(now)
        self._flood.handle_timer(now)
        self._unicast.handle_timer(now)
        self._large.handle_timer(now)
        self._register.handle_timer(now)
        if self._version != self._map.version:
            self._routes_changed(now)
        if self.linking is not None:
            self.linking.handle_timer(now)
        self._members.handle_timer(now)
        self._stops.handle_timer(now)

    def next_deadline(self) -> float:
        """Return the time at which `handle_timer` must be called, as of the last `actions`. It may turn out to be
        early, never late."""
        return self._deadline

    def actions(self) -> list[Action]:
        """Return the actions since the last call, in this order. Call it after everything else: it also computes the
        next deadline, which a node that only carries lockstep messages then has at no cost."""
        self._deadline = min(
            self._map.next_deadline(),
            self._flood.next_deadline(),
            self._unicast.next_deadline(),
            self._large.next_deadline(),
            self._register.next_deadline(),
            _NEVER if self.linking is None else self.linking.next_deadline(),
            self._members.next_deadline(),
            self._stops.next_deadline(),
        )
        actions = self._actions[:]
        self._actions.clear()  # the list itself is shared
        return actions

    def members(self, now: float) -> Members:
        """Return the message for the key `mesh/members`."""
        return self._members.members(now)

    def stopped(self, now: float) -> Stopped:
        """Return the message for the key `mesh/stopped`."""
        return self._stops.stopped(now)

    def graph(self, now: float, after: str = "") -> MeshGraph:
        """Return the message for the key `mesh/graph`: robots with names behind `after`."""
        return self._survey.graph(now, stopped=bool(self._register.stops), after=after)

    def topology(self, now: float) -> Topology:
        """Return the message for the key `mesh/topology`."""
        return self._requests.topology(now)

    def restore_stops(self, halt: Halt, now: float) -> None:
        """Take the stops that an earlier process of this robot knew."""
        self.now = now
        self._register.restore(halt, now)

    def stops_file(self) -> bytes:
        """Return the stops as the bytes to keep through restarts of the process."""
        return self._register.to_file()

    def topology_file(self) -> bytes:
        """Return the topology as the bytes to keep through restarts."""
        assert self.linking is not None
        return self.linking.to_file()

    # -- inside ------------------------------------------------------------------------------------------------

    def _stops_changed(self) -> None:
        self._stops.changed(self.now)
        self._actions.append(WriteStops())  # behind what the bus is told: no stop waits for a file

    def _to_bus(self, key: str, payload: bytes, priority: int) -> None:
        self._actions.append(Received(key, payload, priority))

    def _on_flood(self, origin: str, key: str, payload: bytes, priority: int, incarnation: int) -> None:
        _, service, topic = parse(key)
        if (service, topic) == ("mesh", "lsa"):
            self._map.receive(origin, incarnation, payload, self.now)
            return
        if (service, topic) == ("mesh", "stopped"):
            self._survey.heard(origin, incarnation, key, payload)
        self._to_bus(key, payload, priority)

    def _publish_links(self, payload: bytes) -> None:
        self._flood.publish(self._lsa_key, payload, CONTROL, self.now, latest=True)

    def _towards(self, robot: str) -> str | None:
        route = self._map.route(robot)
        return route.next_hop if route is not None else None

    def _routes_changed(self, now: float, *, look: bool = True) -> None:
        self._version = self._map.version
        if look:
            self._members.routes_changed(now)
        self._flood.ways_changed(now)
        self._unicast.routes_changed(now)
        self._large.ways_changed(now)
        if self.linking is not None:
            self.linking.map_changed(now)


@lru_cache(maxsize=1)
def _sorted(robots: frozenset[str]) -> tuple[str, ...]:
    """Return the names in order; of the robots of a simulation the same for all."""
    return tuple(sorted(robots))
