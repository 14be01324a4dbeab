"""The overlays of many robots joined in memory under virtual time: links that break, die silently, return."""

import itertools
import random
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial

from timed_world import TimedWorld

from services.mesh.core.actions import LinkAction, Transmit, WriteStops
from services.mesh.core.link import Received
from services.mesh.core.overlays.robot_overlays import RobotOverlays
from services.mesh.core.routing.wanted_links import InitialLinks
from swarm.messages import Flooded, FloodRequest, Passed, SendRequest, Sent
from swarm.messages.codec import decode
from swarm.messages.keys import parse

SILENCE = 3.0
"""s until both ends notice that a link has died without a word."""

DATA_OVERHEAD = 5 + 8
"""Bytes of a DATA frame around its payload, tag included."""


@dataclass
class Bot:
    name: str
    overlays: RobotOverlays
    counters: Counter[str]
    inbox: list[tuple[str, bytes]] = field(default_factory=list)
    """What came to the bus from others: key and payload."""
    times: list[float] = field(default_factory=list)


@dataclass
class Edge:
    up: bool = False
    alive: bool = True
    """A link that is up but not alive swallows everything."""
    generation: int = 0


class World(TimedWorld):
    """Robots and their links. Time passes only in `run`."""

    def __init__(
        self,
        edges: Iterable[tuple[str, str]],
        *,
        latency: float = 0.03,
        jitter: float = 0.0,
        loss: float = 0.0,
        seed: int = 0,
        metric: str = "hops",
        start: bool = True,
    ) -> None:
        super().__init__()
        self.random = random.Random(seed)
        self.latency, self.jitter, self.loss, self.metric = latency, jitter, loss, metric
        self.edges = {frozenset(edge): Edge() for edge in edges}
        self.latencies: dict[frozenset[str], float] = {}
        self.neighbours: defaultdict[str, list[str]] = defaultdict(list)
        for a, b in map(sorted, self.edges):
            self.neighbours[a].append(b)
            self.neighbours[b].append(a)
        self.names = sorted(self.neighbours)
        self.bots: dict[str, Bot] = {}
        self.clock_error: dict[str, float] = {}
        self.passed: list[tuple[str, Passed]] = []
        """Who has told that a message was handed on."""
        self.former: list[tuple[str, list[tuple[str, bytes]]]] = []
        """What robots received in the lives that `disturb` has ended."""
        self.lives: Counter[str] = Counter()
        """How many lives of each robot those were."""
        self.messages: Counter[int] = Counter()
        self.bytes: Counter[int] = Counter()
        self.counting: Callable[[Transmit], int] = lambda packet: packet.overlay
        self.kept_stops: dict[str, bytes] = {}
        """The stops that each robot keeps through restarts of its process."""
        self._arrival: dict[tuple[str, str], float] = {}
        self._timers: dict[str, float] = {}
        self._tickets = itertools.count()
        self.watch: Callable[[str, str, Transmit], None] | None = None
        if start:
            for name in self.names:
                self.start(name)

    # -- what a test does --

    def start(self, name: str) -> None:
        """Start a robot; its links to those who run come up after a handshake."""
        counters: Counter[str] = Counter()
        incarnation = int((1000.0 + self.now + self.clock_error.get(name, 0.0)) * 1e6)
        overlays = RobotOverlays(
            name,
            self.names,
            incarnation=incarnation,
            random=self.random.random,
            counters=counters,
            metric=self.metric,
            start=self.beginning(name),
            admits_flood=lambda key: parse(key).service == "rule",
            admits_unicast=lambda sender, key: "set/allowed" in key or key.endswith("/around"),
        )
        self.bots[name] = Bot(name, overlays, counters)
        self._timers[name] = self.now
        self._arm(name)
        for peer in self.neighbours[name]:
            if peer in self.bots:
                self.join(name, peer)

    def kill(self, name: str) -> None:
        """A process dies: its neighbours see their sockets close."""
        del self.bots[name]
        self._timers.pop(name)
        for peer in self.neighbours[name]:
            self.cut(name, peer)

    def leave(self, name: str) -> None:
        """A process stops as told; what it says last arrives before its sockets close."""
        self.step(name, lambda overlays: overlays.leave(self.now))
        self.run(1.1 * self.latency)
        self.kill(name)

    def cut(self, a: str, b: str, *, silent: bool = False) -> None:
        """A link breaks: what is on the way is lost, both ends notice at once or after the silence."""
        edge = self.edges[frozenset((a, b))]
        if not edge.up or not edge.alive:
            return
        edge.alive = False
        edge.generation += 1
        generation = edge.generation
        if silent:
            self.at(self.now + SILENCE, lambda: self._down(a, b, generation))
        else:
            self._down(a, b, generation)

    def join(self, a: str, b: str) -> None:
        """A link comes (back) up after a dial and a handshake."""
        edge = self.edges[frozenset((a, b))]
        generation = edge.generation
        self.at(self.now + 3 * self._latency(a, b), lambda: self._up(a, b, generation))

    def disturb(self, what: str, value: float, option: int = 0) -> None:
        """Do one step of a property: `cut` (silently by `option`) or `join` a link, `restart` a robot, both chosen by
        the number `value`, or `wait` for `value` s. What a robot received before a restart is in `former`."""
        links = [sorted(edge) for edge in self.edges]
        match what:
            case "cut":
                self.cut(*links[int(value) % len(links)], silent=bool(option))
            case "join":
                self.join(*links[int(value) % len(links)])
            case "restart":
                name = self.names[int(value) % len(self.names)]
                self.former.append((name, self.bots[name].inbox))
                self.lives[name] += 1
                self.kill(name)
                self.start(name)
            case "wait":
                self.run(value)

    def settle(self, seconds: float = 2.0) -> None:
        """Run until links are up and routes known, and forget what came meanwhile."""
        self.run(seconds)
        self.clear()

    def clear(self) -> None:
        """Forget what was counted and received."""
        self.messages.clear()
        self.bytes.clear()
        self.passed.clear()
        for bot in self.bots.values():
            bot.inbox.clear()
            bot.times.clear()
            bot.counters.clear()

    def step(self, name: str, call: Callable[[RobotOverlays], object]) -> None:
        """Call a robot's overlays and carry out what they want."""
        bot = self.bots[name]
        call(bot.overlays)
        for action in bot.overlays.actions():
            if isinstance(action, Transmit):
                self._transmit(name, action)
            elif isinstance(action, WriteStops):
                self.kept_stops[name] = bot.overlays.stops_file()
            elif not isinstance(action, Received):
                self.obey(name, action)
            elif action.key.endswith("/mesh/passed"):
                self.passed.append((name, decode(Passed, action.payload, action.key)))
            elif "/mesh/members" not in action.key:
                bot.inbox.append((action.key, action.payload))
                bot.times.append(self.now)
        self._arm(name)

    def flood(self, name: str, payload: bytes, ticket: str = "", announce: bool = False, priority: str = "sync") -> str:
        """What an app asks for."""
        ticket = ticket or f"t{next(self._tickets)}"
        request = FloodRequest(ticket, "test", payload, priority, announce)
        self.step(name, lambda overlays: overlays.request(request, self.now))
        return ticket

    def send(
        self, name: str, to: str, payload: bytes, ticket: str = "", timeout: float = 60.0, priority: str = "sync"
    ) -> str:
        """What an app asks for."""
        ticket = ticket or f"t{next(self._tickets)}"
        request = SendRequest(ticket, "test", to, payload, priority, timeout)
        self.step(name, lambda overlays: overlays.request(request, self.now))
        return ticket

    # -- what a test looks at --

    def got(self, name: str, topic: str) -> list[bytes]:
        """Payloads that came to a robot's bus under keys that end so."""
        return [payload for key, payload in self.bots[name].inbox if key.endswith(topic)]

    def flooded(self, name: str, ticket: str) -> Flooded | None:
        """The answer to a flood."""
        answers = [decode(Flooded, data, "") for data in self.got(name, f"{name}/mesh/flooded")]
        found = [answer for answer in answers if answer.ticket == ticket]
        assert len(found) <= 1
        return found[0] if found else None

    def sent(self, name: str, ticket: str) -> Sent | None:
        """The answer to a message."""
        answers = [decode(Sent, data, "") for data in self.got(name, "/mesh/sent")]
        found = [answer for answer in answers if answer.ticket == ticket]
        assert len(found) <= 1
        return found[0] if found else None

    def states(self, name: str) -> dict[str, str]:
        """Members as a robot sees them."""
        return {member.robot: member.state for member in self.bots[name].overlays.members(self.now).members}

    def changes(self, name: str) -> list[tuple[str, str]]:
        """What has happened to members."""
        return [(change.robot, change.what) for change in self.bots[name].overlays.members(self.now).changes]

    # -- for worlds in which robots choose their links --

    def beginning(self, name: str) -> InitialLinks | None:
        """What a robot knows of links; here that is the test's matter."""
        return None

    def obey(self, name: str, action: LinkAction) -> None:
        """A robot wants another link, or one less."""
        raise AssertionError(f"{name}: {action}")

    # -- the machinery --

    def _latency(self, a: str, b: str) -> float:
        return self.latencies.get(frozenset((a, b)), self.latency)

    def _arm(self, name: str) -> None:
        """Wake a robot at its next deadline; a wake-up that has become too early does no harm."""
        deadline = max(self.bots[name].overlays.next_deadline(), self.now)
        if deadline < float("inf") and (deadline < self._timers[name] or self._timers[name] <= self.now):
            self._timers[name] = deadline
            self.at(deadline, lambda: self._wake(name, deadline))

    def _wake(self, name: str, deadline: float) -> None:
        if name in self.bots and self._timers[name] == deadline:
            self.step(name, lambda overlays: overlays.handle_timer(self.now))

    def _up(self, a: str, b: str, generation: int) -> None:
        edge = self.edges[frozenset((a, b))]
        if edge.up or edge.generation != generation or a not in self.bots or b not in self.bots:
            return
        edge.up = edge.alive = True
        for name, peer in ((a, b), (b, a)):
            self.step(name, lambda overlays, peer=peer: overlays.link_up(peer, self.now))  # type: ignore[misc]

    def _down(self, a: str, b: str, generation: int) -> None:
        edge = self.edges[frozenset((a, b))]
        if edge.generation != generation or not edge.up:
            return
        edge.up = False
        for name, peer in ((a, b), (b, a)):
            if name in self.bots:
                self.step(name, lambda overlays, peer=peer: overlays.link_down(peer, self.now))  # type: ignore[misc]

    def _transmit(self, name: str, packet: Transmit) -> None:
        edge = self.edges[frozenset((name, packet.peer))]
        assert edge.up, f"{name} sends to {packet.peer}, but the link is down"
        kind = self.counting(packet)
        self.messages[kind] += 1
        self.bytes[kind] += len(packet.payload) + DATA_OVERHEAD
        if self.watch is not None:
            self.watch(name, packet.peer, packet)
        if not edge.alive or (self.loss and self.random.random() < self.loss):
            return
        delay = self._latency(name, packet.peer)
        if self.jitter:
            delay = max(0.0, self.random.gauss(delay, self.jitter))
        arrival = max(self.now + delay, self._arrival.get((name, packet.peer), 0.0))
        self._arrival[name, packet.peer] = arrival
        generation = edge.generation
        self.at(arrival, partial(self._receive, name, packet, edge, generation))

    def _receive(self, sender: str, packet: Transmit, edge: Edge, generation: int) -> None:
        if edge.generation != generation or not edge.up or packet.peer not in self.bots:
            return
        overlays = self.bots[packet.peer].overlays
        assert overlays.admits(sender, packet.overlay, packet.key), f"{packet.key} of {sender}"
        self.step(
            packet.peer,
            lambda overlays: overlays.receive(
                sender, packet.overlay, packet.key, packet.payload, packet.priority, self.now
            ),
        )


def line(n: int) -> list[tuple[str, str]]:
    return [(f"r{i}", f"r{i + 1}") for i in range(n - 1)]


def ring(n: int) -> list[tuple[str, str]]:
    return [*line(n), (f"r{n - 1}", "r0")]


def full(n: int) -> list[tuple[str, str]]:
    return [(f"r{i}", f"r{j}") for i in range(n) for j in range(i + 1, n)]


def small_world(n: int, seed: int = 1) -> list[tuple[str, str]]:
    """A ring with chords to places at most 40 away: degree 4 (algorithms: ring and shortcuts)."""
    draw = random.Random(seed)
    edges = {frozenset(edge) for edge in ring(n)}
    degree: Counter[int] = Counter(dict.fromkeys(range(n), 2))
    for i in range(n):
        for _ in range(8):
            j = (i + draw.randint(2, min(40, n // 3))) % n
            if degree[i] >= 4 or degree[j] >= 4 or frozenset((f"r{i}", f"r{j}")) in edges:
                continue
            edges.add(frozenset((f"r{i}", f"r{j}")))
            degree[i] += 1
            degree[j] += 1
    return [(a, b) for a, b in (sorted(edge) for edge in edges)]


def thesis_d() -> Sequence[tuple[str, str]]:
    pairs = [(0, 1), (0, 3), (0, 4), (0, 5), (1, 2), (1, 5), (2, 3), (2, 5), (3, 4), (4, 5)]
    return [(f"r{a}", f"r{b}") for a, b in pairs]


GRAPHS = {"line": line(6), "loop": ring(6), "thesis-d": thesis_d(), "full": full(6)}
FLOOD_KEY = "swarm/{}/app/test/flood"
