"""Unicast: a message to one robot anywhere, hop by hop along the shortest path (thesis 3.4.6).

Each robot on the way looks the next one up in its own table, so a message turns off where a link has died and its
sender need not know. The receiver acknowledges end to end and delivers each message once for each pair of
incarnations, whatever is repeated; the sender repeats after twice the round trip and 100 ms, doubling, five times in
all and for at least 4.5 s (silence takes 3 s to be noticed). What was handed to a link shortly before it died is sent
another way at once. Nobody is busy meanwhile: many messages are in flight, in no particular order.

A message may avoid the link between its sender and its receiver: a link that a wall or a passer-by cuts is part of all
routes until its silence is noticed, and the lockstep needs its neighbour's word sooner (`swarm.core.lockstep`). Such a
message is sent once: the lockstep asks again for what it lacks, and an answer would double the packets on all links of
the way. It has no number, so nobody acknowledges, repeats or keeps it.
"""

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from services.mesh.core.actions import Emit, Transmit
from services.mesh.core.bulk import pieces
from services.mesh.core.bulk.numbered import Limits, Outbound, Outgoing, SeenLives
from services.mesh.core.bulk.pieces import Packet
from services.mesh.core.bulk.transfers import Transfers
from services.mesh.core.routing.topology import Route
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import BULK, SYNC, UNICAST, largest
from services.mesh.core.wire.packets import Ack, UnicastMessage
from swarm.errors import FrameError
from swarm.messages.keys import key as key_of

TTL = 32
"""Hops a message may take, or twice the length of its path where that is more."""

TRIES = 5
FIRST_WAIT = 0.1
"""s on top of twice the path's round trip until a message is sent again."""
LONGEST_WAIT = 4.0
LEAST_PATIENCE = 4.5
"""Seconds that a message is tried at least: longer than silence takes to be noticed."""

WINDOW = 256
"""Numbers a receiver can tell apart below the highest it has seen of one sender."""

MAX_IN_FLIGHT = 128
"""Span of numbers not yet acknowledged to one receiver, below `WINDOW`; what is more waits."""

MAX_WAITING = 512
"""Messages of this robot that wait for an answer or for their turn, and their bytes; more are refused."""
MAX_WAITING_BYTES = 512 * 1024

CUSTODY = 64
CUSTODY_TIME = 4.5
"""Packets, and s, for which what was handed to a link is kept to be sent another way should it die."""

COUNTERS = ("unicast_avoiding", "unicast_duplicates", "unicast_expired", "unicast_forwarded", "unicast_no_route",
            "unicast_refused", "unicast_rerouted", "unicast_retries")  # fmt: skip

_NEVER = float("inf")


class Hop(NamedTuple):
    """A message, or the answer to it, is handed to a neighbour."""

    sender: str
    """The sender of the message, also where it is the answer."""
    to: str
    number: int
    """Counts what this sender sent to this receiver, from 1."""
    next_hop: str
    """The neighbour."""
    back: bool
    """Whether it is the answer."""
    key: str = ""
    """The key of the message. An answer has none: empty on its way, known where it begins."""
    token: object = None
    """The token with which an own message was sent."""


@dataclass(eq=False)
class Flight(Outgoing):
    """An own message until its end."""

    priority: int = field(kw_only=True)
    began: float = 0.0
    tries: int = 0
    via: str | None = None
    """The neighbour it was handed to; None where there was no route."""


class FindRoute(Protocol):
    """A function that finds routes."""

    def __call__(self, to: str, avoided: tuple[str, str] | None = None) -> Route | None:
        """Return the route to the robot `to` that does not use the link between the two robots `avoided`; None where
        there is none."""


class Unicast:
    """The unicast overlay of one robot. Calls with `now` must not go back in time."""

    def __init__(
        self,
        me: str,
        incarnation: int,
        robots: frozenset[str],
        *,
        emit: Emit,
        route: FindRoute,
        admits: Callable[[str, str], bool],
        deliver: Callable[[str, bytes, int], None],
        ended: Callable[[object, str, str], None],
        passed: Callable[[Hop], None],
        counters: Counter[str],
    ) -> None:
        """`admits(sender, key)` says what may come in; `ended(token, to, problem)` is called once for each `send`,
        with an empty problem where the message was delivered; `passed(hop)` each time that this robot hands a message
        or an answer to a neighbour. `on_large(packet, now)`, which takes what comes for this robot about large
        messages, is to be set before anything comes."""
        self._me = me
        self._incarnation = incarnation
        self._robots = robots
        self._emit = emit
        self._route = route
        self._admits = admits
        self._deliver = deliver
        self._ended = ended
        self._passed = passed
        self._counters = counters
        self.on_large: Callable[[Packet, float], None]
        self.transfers = Transfers(
            me, incarnation, emit=self.carry, admits=admits, deliver=deliver, ended=ended, counters=counters
        )
        self._channel = key_of(me, "mesh", "unicast")
        # Pieces have a channel of their own, so that what is small and of their class need not wait behind them.
        self._pieces_channel = key_of(me, "mesh", "pieces")
        limits = Limits(MAX_WAITING, MAX_WAITING_BYTES, MAX_IN_FLIGHT, MAX_IN_FLIGHT)
        self._own = Outbound[Flight](limits, self._launch, ended)
        self._seen = SeenLives(WINDOW)
        self._custody: dict[str, deque[tuple[float, Hop, str, bytes, int]]] = {}

    # -- own messages ------------------------------------------------------------------------------------------

    def send(
        self,
        token: object,
        to: str,
        key: str,
        payload: bytes,
        priority: int,
        now: float,
        *,
        timeout: float = _NEVER,
        latest: bool = False,
    ) -> None:
        """Send; with `latest` an older message of this key that still waits for its answer is given up."""
        if latest:
            self.transfers.give_up(to, key)
            self._own.give_up(to, key)
        if to not in self._robots:
            self._ended(token, to, f"there is no robot {to}")
        elif len(payload) > (limit := largest(priority, packets.UNICAST_ROOM)):
            self._ended(token, to, f"{len(payload)} bytes, a message has at most {limit} in its class")
        elif to == self._me:
            self._deliver(key, payload, priority)
            self._ended(token, to, "")
        elif len(payload) > packets.UNICAST_ROOM:
            self.transfers.send(token, to, key, payload, now, now + timeout)
        elif not self._own.has_room(len(payload)):
            self._ended(token, to, "too many messages wait for their answers")
        else:
            self._own.add(Flight(token, to, key, payload, now + timeout, priority=priority), now)

    def send_once(self, to: str, key: str, payload: bytes, priority: int) -> None:
        """Send over other robots than the link with the receiver, once, without an answer. Payloads have at most
        `packets.UNICAST_ROOM` bytes. Without a way the message is dropped and counted."""
        if (route := self._route(to, (self._me, to))) is None:
            self._counters["unicast_no_route"] += 1
            return
        self._counters["unicast_avoiding"] += 1
        message = UnicastMessage(self._me, to, self._incarnation, 0, key, payload, ttl_of(route))
        self._emit(Transmit(route.next_hop, UNICAST, self._channel, packets.encode_message(message), priority))

    # -- inputs ------------------------------------------------------------------------------------------------

    def receive(self, peer: str, data: bytes, priority: int, now: float) -> None:
        """Take a packet of a neighbour. Raises `FrameError`."""
        match packets.kind_of(data):
            case packets.MESSAGE:
                message = packets.decode_message(data)
                self._check(message.sender, message.to)
                if message.to == self._me:
                    self._on_message(message, priority, now)
                else:
                    self._forward(message, priority, now)
            case packets.ACK:
                ack = packets.decode_ack(data)
                self._check(ack.sender, ack.to)
                if ack.to == self._me:
                    self._on_ack(ack, now)
                else:
                    self._forward(ack, priority, now)
            case kind if pieces.OFFER <= kind <= pieces.GONE:
                packet = pieces.decode(data)
                self._check(packet.sender, packet.to, packet.id.origin)
                if packet.to == self._me:
                    self.on_large(packet, now)
                elif packet.ttl <= 1:
                    self._counters["unicast_expired"] += 1
                elif (route := self._route(packet.to)) is None:
                    self._counters["unicast_no_route"] += 1
                else:
                    self._counters["unicast_forwarded"] += 1
                    self._emit_large(route.next_hop, packet.kind, pieces.passed_on(data))
            case kind:
                raise FrameError(f"unicast packet kind {kind}: not known")

    def carry(self, packet: Packet) -> bool:
        """Send a packet about a large message; False where there is no way. Nobody repeats it but who needs it."""
        route = self._route(packet.to)
        if route is None:
            return False
        data = pieces.encode(packet._replace(ttl=ttl_of(route)))
        self._emit_large(route.next_hop, packet.kind, data)
        return True

    def _emit_large(self, peer: str, kind: int, data: bytes) -> None:
        channel = self._pieces_channel if kind == pieces.PIECE else self._channel
        self._emit(Transmit(peer, UNICAST, channel, data, BULK))

    def link_down(self, peer: str, now: float) -> None:
        """Send what a lost neighbour was handed lately another way. The routes know of the loss already."""
        for at, hop, to, data, priority in self._custody.pop(peer, ()):
            if at + CUSTODY_TIME >= now and (route := self._route(to)) is not None:
                self._counters["unicast_rerouted"] += 1
                self._hand_over(hop._replace(next_hop=route.next_hop), to, data, priority, now)
        for flight in self._own.under_way():
            if flight.via == peer:
                self._transmit(flight, now)

    def routes_changed(self, now: float) -> None:
        """Send the messages that had no route, since there may be new ones."""
        for flight in self._own.under_way():
            if flight.via is None:
                self._transmit(flight, now)

    def handle_timer(self, now: float) -> None:
        """Repeat, or give up."""
        for flight in self._own.all():
            if now >= flight.deadline:
                self._own.end(flight, f"no answer from {flight.to} in time", now)
            elif now >= flight.next_at:
                self._repeat(flight, now)

    def next_deadline(self) -> float:
        """Return the time at which `handle_timer` must be called."""
        return self._own.next_deadline()

    # -- the sender's side -------------------------------------------------------------------------------------

    def _launch(self, flight: Flight, now: float) -> None:
        flight.began = now
        flight.tries = 1
        self._transmit(flight, now)
        flight.wait = self._first_wait(flight.to)
        flight.next_at = now + flight.wait

    def _transmit(self, flight: Flight, now: float) -> None:
        route = self._route(flight.to)
        flight.via = route.next_hop if route is not None else None
        if route is not None:
            message = UnicastMessage(
                self._me, flight.to, self._incarnation, flight.number, flight.key, flight.payload, ttl_of(route)
            )
            self._passed(_hop(message, route.next_hop)._replace(token=flight.token))
            self._emit(
                Transmit(route.next_hop, UNICAST, self._channel, packets.encode_message(message), flight.priority)
            )

    def _first_wait(self, to: str) -> float:
        route = self._route(to)
        return FIRST_WAIT + (2 * 2 * route.time * 1e-4 if route is not None else 0.0)

    def _repeat(self, flight: Flight, now: float) -> None:
        if flight.tries < TRIES:
            flight.tries += 1
            self._counters["unicast_retries"] += 1
            self._transmit(flight, now)
            flight.wait = min(2 * max(flight.wait, self._first_wait(flight.to) / 2), LONGEST_WAIT)
            flight.next_at = now + flight.wait
        elif now < flight.began + LEAST_PATIENCE:
            flight.next_at = flight.began + LEAST_PATIENCE
        elif flight.via is None:
            self._own.end(flight, f"no way to {flight.to}", now)
        else:
            self._own.end(flight, f"no answer from {flight.to} after {flight.tries} tries", now)

    def _on_ack(self, ack: Ack, now: float) -> None:
        flight = self._own.get(ack.sender, ack.number)
        if flight is not None and ack.incarnation == self._incarnation:
            self._own.end(flight, f"{ack.sender} lets no {flight.key} in" if ack.refused else "", now)

    # -- the receiver's side -----------------------------------------------------------------------------------

    def _on_message(self, message: UnicastMessage, priority: int, now: float) -> None:
        refused = not self._admits(message.sender, message.key)
        if refused:
            self._counters["unicast_refused"] += 1
        elif not message.number or self._seen.of(message.sender, message.incarnation).add(message.number):
            self._deliver(message.key, message.payload, priority)
        else:
            self._counters["unicast_duplicates"] += 1
        if not message.number:
            return
        # Not more urgent than sync unless the message was: a burst of answers must not push LSAs and stops out of the
        # control class.
        ack = Ack(self._me, message.sender, message.incarnation, message.number, refused, TTL)
        route = self._route(message.sender)
        if route is not None:
            ack = ack._replace(ttl=ttl_of(route))
            hop = _hop(ack, route.next_hop)._replace(key=message.key)
            self._hand_over(hop, message.sender, packets.encode_ack(ack), min(priority, SYNC), now)
        else:
            self._counters["unicast_no_route"] += 1

    # -- on the way --------------------------------------------------------------------------------------------

    def _check(self, *names: str) -> None:
        for name in names:
            if name not in self._robots:
                raise FrameError(f"unicast packet of or for {name}, which is not in our configuration")

    def _forward(self, packet: UnicastMessage | Ack, priority: int, now: float) -> None:
        route = self._route(packet.to, packet.avoided if isinstance(packet, UnicastMessage) else None)
        if packet.ttl <= 1:
            self._counters["unicast_expired"] += 1
        elif route is None:
            self._counters["unicast_no_route"] += 1
        else:
            self._counters["unicast_forwarded"] += 1
            ttl = packet.ttl - 1
            if isinstance(packet, UnicastMessage):
                data = packets.encode_message(packet._replace(ttl=ttl))
            else:
                data = packets.encode_ack(packet._replace(ttl=ttl))
            if not packet.number:
                self._emit(Transmit(route.next_hop, UNICAST, self._channel, data, priority))
                return
            self._hand_over(_hop(packet, route.next_hop), packet.to, data, priority, now)

    def _hand_over(self, hop: Hop, to: str, data: bytes, priority: int, now: float) -> None:
        self._passed(hop)
        custody = self._custody.get(hop.next_hop)
        if custody is None:
            custody = self._custody[hop.next_hop] = deque(maxlen=CUSTODY)
        custody.append((now, hop, to, data, priority))
        self._emit(Transmit(hop.next_hop, UNICAST, self._channel, data, priority))


def _hop(packet: UnicastMessage | Ack, next_hop: str) -> Hop:
    if isinstance(packet, UnicastMessage):
        return Hop(packet.sender, packet.to, packet.number, next_hop, back=False, key=packet.key)
    return Hop(packet.to, packet.sender, packet.number, next_hop, back=True)


def ttl_of(route: Route) -> int:
    """Hops that a packet on this way may take."""
    return min(max(TTL, 2 * route.hops), 255)
