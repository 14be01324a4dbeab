"""The requests of apps to the overlays, and the answers that they get.

A request carries a ticket. One that is repeated is done once and answered again, since the bus may lose both. A large
payload is not repeated for that: a reminder names the ticket alone, and leads to the answer, to how far it is, or to
the word that there is no such request here.
"""

from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Mapping

from services.mesh.core.overlays import flood
from services.mesh.core.overlays.unicast import Hop, Unicast
from services.mesh.core.routing.topology import Route
from services.mesh.core.routing.wanted_links import Linking
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import BULK, CONTROL, PRIORITIES, largest
from swarm.frozen import frozen
from swarm.messages import (
    Flooded,
    FloodRequest,
    Passed,
    Progress,
    Reminder,
    SendRequest,
    Sent,
    Topology,
    TopologyRequest,
    TopologySet,
)
from swarm.messages.codec import encode
from swarm.messages.keys import is_name, parse
from swarm.messages.keys import key as key_of

LEAST_PATIENCE = {CONTROL: 1.0}
LEAST_PATIENCE_ELSE = 3.0
"""Seconds that one try of a confirmed flood may take at least; less urgent classes may have to wait in queues."""

MAX_TICKETS = 1024
"""Requests whose answers are remembered, so that a repeated request is answered again, not done again."""


@frozen
class _Ticket:
    """A request that awaits its answer."""

    ticket: str
    app: str


Request = FloodRequest | SendRequest | Reminder | TopologyRequest
Answer = Flooded | Sent | TopologySet


class OverlayRequests:
    """The requests of all apps of one robot."""

    def __init__(
        self,
        me: str,
        *,
        to_bus: Callable[[str, bytes, int], None],
        now: Callable[[], float],
    ) -> None:
        """`flood`, `unicast` and `routes` (the ways to all robots) are to be set before anything is asked."""
        self._me = me
        self._to_bus = to_bus
        self._now = now
        self.flood: flood.FloodOverlay
        self.unicast: Unicast
        self.routes: Callable[[], Mapping[str, Route]]
        self.linking: Linking | None = None
        self._tickets: OrderedDict[str, Answer | _Ticket] = OrderedDict()
        self._keys = {
            Flooded: key_of(me, "mesh", "flooded"),
            Sent: key_of(me, "mesh", "sent"),
            TopologySet: key_of(me, "mesh", "topology_set"),
        }
        self._progress_key = key_of(me, "mesh", "progress")
        self._passed_key = key_of(me, "mesh", "passed")

    def take(self, request: Request) -> None:
        """Do what is asked; the answer goes to the own bus."""
        match request:
            case FloodRequest():
                self._request_flood(request)
            case SendRequest():
                self._request_send(request)
            case TopologyRequest():
                if self.linking is not None:
                    self._request_topology(request, self.linking)
            case Reminder():
                self._remind(request)

    def topology(self, now: float) -> Topology:
        """Return the message for the key `mesh/topology`, which also shows what became of a request for other links."""
        linking = self.linking
        assert linking is not None
        value = linking.value
        return Topology(
            t=now,
            version=value.version,
            step=value.step,
            issuer=value.issuer,
            auto=value.auto,
            since=now if linking.adopted is None else linking.adopted,
            edges=value.edges,
            wanted=tuple(sorted(linking.neighbours)),
            up=linking.up,
            kept=linking.kept,
            missing=dict(linking.missing),
            links=linking.physical if linking.carried else (),
            hub=linking.hub(),
        )

    def _request_flood(self, request: FloodRequest) -> None:
        """The answer goes to `mesh/flooded`."""
        token = _Ticket(request.ticket, request.app)
        if self._is_known(token):
            return
        problem = _problem(request.app, request.priority)
        priority = PRIORITIES.get(request.priority, BULK)
        if len(request.payload) > (limit := largest(priority, packets.room(all_know=request.announce))):
            problem = f"{len(request.payload)} bytes, a flood has at most {limit} in its class"
        if not problem:
            key = key_of(self._me, "app", request.app, "flood")
            patience, now = self._patience(priority), self._now()
            if self.flood.confirm(token, key, request.payload, priority, patience, now, all_know=request.announce):
                return
            problem = "too many floods, or bytes of large ones, are under way"
        self._answer_flood(token, (), complete=False, problem=problem)

    def _request_send(self, request: SendRequest) -> None:
        """The answer goes to `mesh/sent`."""
        token = _Ticket(request.ticket, request.app)
        if self._is_known(token):
            return
        problem = _problem(request.app, request.priority) or ("" if is_name(request.to) else "that is no robot's name")
        if problem:
            self.sent(token, request.to, problem)
            return
        key = key_of(self._me, "app", request.app, "send", request.to)
        priority = PRIORITIES[request.priority]
        self.unicast.send(token, request.to, key, request.payload, priority, self._now(), timeout=request.timeout)

    def _request_topology(self, request: TopologyRequest, linking: Linking) -> None:
        """Somebody's wish for other links; the answer goes to `mesh/topology_set`."""
        if self._is_known(_Ticket(request.ticket, "")):
            return
        problem = linking.set(request.shape, request.edges, request.after, self._now())
        self._end(TopologySet(self._now(), request.ticket, linking.value.version, problem))

    def _remind(self, reminder: Reminder) -> None:
        """Tell the answer again, or how far it is."""
        known = self._tickets.get(reminder.ticket)
        if known is not None and not isinstance(known, _Ticket):
            self._tell(known)
            return
        moved, size = 0, 0
        if known is not None:
            moved, size = self.unicast.transfers.progress(known) or self.flood.progress(known) or (0, 0)
        progress = Progress(self._now(), reminder.ticket, known is not None, size, moved)
        self._to_bus(self._progress_key, encode(progress), CONTROL)

    def reached(self, token: object, robots: frozenset[str], complete: bool) -> None:
        """Answer the request of a flood that has ended."""
        if isinstance(token, _Ticket):
            problem = "" if complete else "a link broke, or a robot did not answer"
            self._answer_flood(token, sorted_names(robots), complete=complete, problem=problem)

    def all_have(self, key: str, robots: Collection[str]) -> None:
        """Report on the own bus that all have another robot's flood; there it has no ticket."""
        origin, _, topic = parse(key)
        others = sorted_names(set(robots) - {origin})
        answer = Flooded(self._now(), "", topic.partition("/")[0], others, complete=True, problem="")
        self._to_bus(key_of(origin, "mesh", "flooded"), encode(answer), CONTROL)

    def sent(self, token: object, to: str, problem: str) -> None:
        """Answer the request of a message that has ended."""
        if isinstance(token, _Ticket):
            self._end(Sent(self._now(), token.ticket, token.app, to, not problem, problem))

    def passed(self, hop: Hop) -> None:
        """This robot has handed a message, or the answer to one, to a neighbour: told of those of apps. What an answer
        was to is not known on its way."""
        app = app_of(hop.key)
        if not app and (hop.key or not hop.back):
            return
        ticket = hop.token.ticket if isinstance(hop.token, _Ticket) else ""
        passed = Passed(self._now(), app, hop.sender, hop.to, hop.number, hop.back, hop.next_hop, ticket)
        self._to_bus(self._passed_key, encode(passed), CONTROL)

    def _patience(self, priority: int) -> float:
        """Return how long a confirmed flood may take, s: 4 (D + 1) L, twice the time there and back, 2 D L, and one
        hop to spare."""
        farthest = max(self.routes().values(), key=lambda route: route.time, default=None)
        least = LEAST_PATIENCE.get(priority, LEAST_PATIENCE_ELSE)
        if farthest is None:
            return least
        return max(least, 4 * (farthest.hops + 1) * (farthest.time / farthest.hops) * 1e-4)

    def _answer_flood(self, token: _Ticket, robots: tuple[str, ...], *, complete: bool, problem: str) -> None:
        self._end(Flooded(self._now(), token.ticket, token.app, robots, complete, problem))

    def _is_known(self, token: _Ticket) -> bool:
        """Return whether a request was seen before; its answer, if it is there, is told again."""
        known = self._tickets.get(token.ticket)
        if known is not None:
            if not isinstance(known, _Ticket):
                self._tell(known)
            return True
        self._remember(token)
        return False

    def _end(self, answer: Answer) -> None:
        self._remember(answer)
        self._tell(answer)

    def _remember(self, known: Answer | _Ticket) -> None:
        if known.ticket not in self._tickets and len(self._tickets) >= MAX_TICKETS:
            self._tickets.popitem(last=False)
        self._tickets[known.ticket] = known

    def _tell(self, answer: Answer) -> None:
        self._to_bus(self._keys[type(answer)], encode(answer), CONTROL)


def app_of(key: str) -> str:
    """Return the app that a message's key belongs to, `swarm/<sender>/app/<app>/send/<to>`; empty where it is no
    app's."""
    chunks = key.split("/")
    return chunks[3] if len(chunks) == 6 and chunks[2] == "app" and chunks[4] == "send" else ""


def _problem(app: str, priority: str) -> str:
    """Explain what is wrong with a request; empty where nothing is."""
    if not is_name(app):
        return f"{app[:40]!r} is no app's name"
    if priority not in PRIORITIES:
        return f"priority {priority[:40]!r}: expected {', '.join(PRIORITIES)}"
    return ""


def sorted_names(names: Iterable[str]) -> tuple[str, ...]:
    """Robots' names as results show them: r2 before r10."""
    return tuple(sorted(names, key=lambda name: (len(name), name)))
