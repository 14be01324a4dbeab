"""Robots that choose their links themselves, over who can hear whom, under virtual time."""

from collections.abc import Collection, Iterable, Sequence
from itertools import combinations

import networkx as nx
from overlay_world import World

from services.mesh.core.actions import Connect, Disconnect, LinkAction, Write
from services.mesh.core.routing.topology import Ground, TopologyVersion
from services.mesh.core.routing.wanted_links import InitialLinks, Linking
from swarm.messages import TopologyRequest

RETRY = 1.0
"""s between two calls of a neighbour."""


def names_of(count: int) -> list[str]:
    return [f"r{i}" for i in range(count)]


class TopologyWorld(World):
    """Of two robots the one with the lower place calls the other."""

    def __init__(
        self,
        count: int,
        topology: Iterable[tuple[str, str]] = (),
        *,
        reach: Collection[tuple[str, str]] | None = None,
        auto: bool = False,
        latency: float = 0.03,
        jitter: float = 0.0,
        seed: int = 0,
        slow: float = 0.0,
        start: bool = True,
    ) -> None:
        """`reach` are the pairs that hear each other; None = all. A call takes up to `slow` s more than it must."""
        names = names_of(count)
        self.ground = Ground(names, tuple(topology), auto=auto)
        self.saved: dict[str, TopologyVersion] = {}
        self.lasting: dict[str, set[str]] = {name: set() for name in names}
        self.blocked: set[frozenset[str]] = set()
        self.slow = slow
        self.gentle = True
        """Whether it would be a fault if a link that a robot gives up split the swarm."""
        self.given_up = 0
        self.calls = 0
        self.values: list[TopologyVersion] = []
        """Every value that a robot took over."""
        super().__init__(reach if reach is not None else combinations(names, 2), latency=latency, jitter=jitter,
                         seed=seed, start=False)  # fmt: skip
        self.names = names
        if start:
            for name in names:
                self.start(name)

    # -- what a test does --

    def change(
        self, name: str, shape: str = "", edges: Sequence[tuple[str, str]] = (), after: int | None = None
    ) -> None:
        request = TopologyRequest(f"s{next(self._tickets)}", shape, tuple(edges), after)
        self.step(name, lambda overlays: overlays.request(request, self.now))

    def start(self, name: str) -> None:
        self.lasting[name].clear()
        super().start(name)

    def cut(self, a: str, b: str, *, silent: bool = False) -> None:
        """They do not hear each other any more."""
        if (edge := self.edges.get(frozenset((a, b)))) is not None:
            self.blocked.add(frozenset((a, b)))
            if edge.up:
                super().cut(a, b, silent=silent)

    def join(self, a: str, b: str) -> None:
        """They hear each other again."""
        self.blocked.discard(frozenset((a, b)))

    def kill(self, name: str) -> None:
        before = set(self.blocked)
        super().kill(name)
        self.blocked = before

    # -- what it looks at --

    def linking(self, name: str) -> Linking:
        linking = self.bots[name].overlays.linking
        assert linking is not None
        return linking

    def value(self, name: str) -> TopologyVersion:
        return self.linking(name).value

    def graph(self) -> "nx.Graph[str]":
        """The links that are up."""
        graph: nx.Graph[str] = nx.Graph()
        graph.add_nodes_from(self.bots)
        graph.add_edges_from(tuple(edge) for edge, state in self.edges.items() if state.up)
        return graph

    def agreed(self) -> TopologyVersion:
        """The value that all have."""
        (value,) = {self.value(name) for name in self.bots}
        return value

    def links(self) -> set[tuple[str, str]]:
        place = {name: index for index, name in enumerate(self.names)}
        return {(a, b) if place[a] < place[b] else (b, a) for a, b in self.graph().edges}

    # -- the machinery --

    def beginning(self, name: str) -> InitialLinks:
        place = self.names.index(name)
        dials = {other: place < self.names.index(other) for other in self.names if other != name}
        return InitialLinks(self.ground, dials, self.saved.get(name))

    def obey(self, name: str, action: LinkAction) -> None:
        match action:
            case Connect(peer, once):
                if not once:
                    self.lasting[name].add(peer)
                if once or self.names.index(name) < self.names.index(peer):
                    delay = 1.5 * self.latency + self.slow * self.random.random()
                    self.at(self.now + delay, lambda: self._call(name, peer, once=once))
            case Disconnect(peer, _):
                self.lasting[name].discard(peer)
                edge = self.edges.get(frozenset((name, peer)))
                if edge is not None and edge.up and edge.alive:
                    self._give_up(name, peer)
            case Write():
                self.saved[name] = self.value(name)
                self.values.append(self.value(name))

    def _give_up(self, name: str, peer: str) -> None:
        self.given_up += 1
        edge = self.edges[frozenset((name, peer))]
        edge.alive = False
        edge.generation += 1
        self._down(name, peer, edge.generation)
        if self.gentle:
            assert nx.has_path(self.graph(), name, peer), f"{name} gives {peer} up, there is no other way"

    def _call(self, name: str, peer: str, *, once: bool) -> None:
        if name not in self.bots or not (once or peer in self.lasting[name]):
            return
        pair = frozenset((name, peer))
        edge = self.edges.get(pair)
        if not once and edge is not None and edge.up:
            return  # when it goes down, it is called again
        self.calls += 1
        if edge is None or pair in self.blocked or peer not in self.bots:
            self._failed(name, peer, "unreachable")
        elif not self.linking(peer).has_room(name):
            self._failed(name, peer, "the other end says: full")
        else:
            self.at(self.now + 1.5 * self.latency, lambda: self._up(name, peer, edge.generation))

    def _failed(self, name: str, peer: str, problem: str) -> None:
        self.step(name, lambda overlays: overlays.dial_failed(peer, problem, self.now))
        if peer in self.lasting[name]:
            self.at(self.now + RETRY, lambda: self._call(name, peer, once=False))

    def _up(self, a: str, b: str, generation: int) -> None:
        """`a` has called."""
        edge = self.edges[frozenset((a, b))]
        if a not in self.bots:
            return
        if edge.generation != generation or edge.up or b not in self.bots or frozenset((a, b)) in self.blocked:
            self._failed(a, b, "connection lost")
            return
        edge.up = edge.alive = True
        useful = True
        for name, peer in ((a, b), (b, a)):
            if not useful or not edge.up:
                break

            def up(overlays, peer=peer):  # type: ignore[no-untyped-def]
                nonlocal useful
                useful = overlays.link_up(peer, self.now)

            self.step(name, up)
        if not useful and edge.up:
            edge.generation += 1
            edge.alive = False
            self._down(a, b, edge.generation)

    def _down(self, a: str, b: str, generation: int) -> None:
        edge = self.edges[frozenset((a, b))]
        was_up = edge.up
        super()._down(a, b, generation)
        if was_up and not edge.up:
            for name, peer in ((a, b), (b, a)):
                if name in self.bots and peer in self.lasting[name] and self.names.index(name) < self.names.index(peer):
                    self.at(self.now + RETRY, lambda name=name, peer=peer: self._call(name, peer, once=False))  # type: ignore[misc]
