"""topology = "auto": the plan, the search, and swarms that find and mend themselves over who can hear whom."""

import random
from itertools import combinations

import networkx as nx
import pytest
from conftest import costly, examples
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from topology_world import TopologyWorld, names_of

from services.mesh.core.link.calls import JITTER, LONGEST_FAR, LONGEST_NEAR, Search
from services.mesh.core.routing.automatic_topology import plan
from services.mesh.core.routing.topology import MAX_LINKS

Edges = set[tuple[str, str]]

FOUND_S = (1.0 + JITTER) * LONGEST_NEAR + 30.0
"""Seconds in which robots that hear each other have called each other, and settled on a topology."""


def network(names: list[str], edges: object) -> "nx.Graph[str]":
    graph: nx.Graph[str] = nx.Graph()
    graph.add_nodes_from(names)
    graph.add_edges_from(edges)  # type: ignore[arg-type]
    return graph


@st.composite
def reaches(draw: st.DrawFn, n: int) -> Edges:
    """Who hears whom: in parts, in one, or all each other."""
    pairs = sorted(combinations(names_of(n), 2))
    if draw(st.booleans()):
        return set(pairs)
    return set(draw(st.lists(st.sampled_from(pairs), max_size=3 * n))) if pairs else set()


# -- the plan ----------------------------------------------------------------------------------------------------------


@costly(150)
@given(data=st.data(), n=st.integers(1, 12))
def test_a_plan_connects_whom_ears_connect_and_changes_nothing_of_itself(data: st.DataObject, n: int) -> None:
    names = names_of(n)
    members = sorted(data.draw(st.sets(st.sampled_from(names), min_size=1)))
    heard = {edge for edge in data.draw(reaches(n)) if set(edge) <= set(members)}
    pairs = sorted(combinations(names, 2))
    before = set(data.draw(st.lists(st.sampled_from(pairs), max_size=n))) if pairs else set()
    up = {edge for edge in heard if data.draw(st.booleans())}
    edges = plan(names, members, sorted(before), sorted(heard), sorted(up))
    assert plan(names, members, edges, sorted(heard), sorted(up)) == edges
    whole, live, ears = network(names, edges), network(members, set(edges) & heard), network(members, heard)
    assert max((degree for _, degree in whole.degree), default=0) <= MAX_LINKS
    assert nx.number_connected_components(live) == nx.number_connected_components(ears)
    # What cannot be used now stays, for those who come back; nothing else is made up.
    assert {edge for edge in edges if edge not in heard} <= before
    if len(members) > 2 and nx.is_biconnected(ears):
        assert nx.is_biconnected(live)


def test_of_all_who_hear_each_other_few_links_make_a_small_world() -> None:
    for n, links, diameter in ((3, 3, 1), (6, 6, 3), (20, 26, 5), (50, 72, 6)):
        names = names_of(n)
        edges = plan(names, names, (), list(combinations(names, 2)), ())
        graph = network(names, edges)
        assert (len(edges), nx.diameter(graph)) == (links, diameter)
        assert nx.is_biconnected(graph)


def test_too_many_links_become_fewer() -> None:
    names = names_of(8)
    full = list(combinations(names, 2))
    edges = plan(names, names, full, full, full)
    assert len(edges) < len(full)
    assert max(degree for _, degree in network(names, edges).degree) < MAX_LINKS
    assert nx.is_biconnected(network(names, edges))


def test_a_full_robot_gives_way_where_others_can_do_without_it() -> None:
    """All hear r0; r1 to r8 hear the next one. r0 has seven links, r8 none."""
    names = names_of(9)
    ears = [("r0", name) for name in names[1:]] + [(f"r{i}", f"r{i + 1}") for i in range(1, 8)]
    star = [("r0", f"r{i}") for i in range(1, 8)]
    edges = plan(names, names, star, ears, star)
    assert nx.is_connected(network(names, edges))
    assert network(names, edges).degree["r0"] < MAX_LINKS


# -- the search --------------------------------------------------------------------------------------------------------


def test_one_call_at_a_time_the_far_ones_first_with_growing_pauses() -> None:
    search = Search(random.Random(1).random)
    search.aim(["a"], ["b"], 0.0)
    assert search.take(1.0) == "a"
    assert search.take(1.0) is None
    assert search.next_deadline() == float("inf")
    search.ended("a", 1.0)
    assert search.take(1.0) == "b"
    search.ended("b", 1.0)
    now, calls = 1.0, {"a": [0.0], "b": [0.0]}
    while now < 5000.0:
        now = search.next_deadline()
        name = search.take(now)
        assert name is not None
        calls[name].append(now)
        search.ended(name, now)
    for name, longest in (("a", LONGEST_FAR), ("b", LONGEST_NEAR)):
        gaps = [y - x for x, y in zip(calls[name][-8:], calls[name][-7:], strict=False)]
        assert all(0.5 * longest <= gap <= 1.5 * longest + 1.0 for gap in gaps)
    # Who was in the swarm and is out of it is called at once.
    search.aim(["b"], [], now)
    assert search.next_deadline() <= now + 0.5


# -- whole swarms ------------------------------------------------------------------------------------------------------


def check(world: TopologyWorld, reach: Edges) -> None:
    """Everybody whom ears connect is connected, agrees, and has what the topology says."""
    running = sorted(world.bots)
    ears = network(
        running, [edge for edge in reach if set(edge) <= set(running) and frozenset(edge) not in world.blocked]
    )
    graph = world.graph()
    assert max((degree for _, degree in graph.degree), default=0) <= MAX_LINKS
    for part in nx.connected_components(ears):
        assert nx.is_connected(graph.subgraph(part)), f"{sorted(part)}: {sorted(graph.edges)}"
        (value,) = {world.value(name) for name in part}
        wanted = {edge for edge in value.edges if set(edge) <= part and set(edge) <= set(running)}
        linked = {tuple(sorted(edge)) for edge in graph.subgraph(part).edges}
        assert linked == {tuple(sorted(edge)) for edge in wanted if frozenset(edge) not in world.blocked}
        here = ears.subgraph(part)
        if len(part) > 2 and nx.is_biconnected(here):
            assert nx.is_biconnected(graph.subgraph(part))


@costly(25)
@given(data=st.data(), n=st.integers(2, 9), seed=st.integers(0, 99), slow=st.sampled_from([0.0, 1.0]))
def test_from_nothing_to_a_swarm_that_stays_as_it_is(data: st.DataObject, n: int, seed: int, slow: float) -> None:
    reach = data.draw(reaches(n))
    world = TopologyWorld(n, reach=reach, auto=True, seed=seed, jitter=0.01, slow=slow)
    world.run(120.0)
    check(world, reach)
    values, calls = len(world.values), world.calls
    world.run(1200.0)
    assert len(world.values) == values, "it changes though nothing does"
    # Whom nobody hears is called each 30 s, or 300 s within the swarm.
    assert world.calls - calls <= (n * (n - 1) // 2 - len(world.links())) * 1200 / 12
    check(world, reach)


def test_a_dozen_that_hear_each_other_are_one_swarm_in_seconds() -> None:
    world = TopologyWorld(12, auto=True)
    world.run(5.0)
    assert nx.is_connected(world.graph())
    assert len({world.value(name) for name in world.bots}) == 1
    world.run(10.0)
    check(world, set(combinations(names_of(12), 2)))
    assert len(set(world.values)) <= 3


def test_the_eighth_at_a_hub_is_told_why_it_stays_out() -> None:
    reach = {("r0", f"r{i}") for i in range(1, 10)}
    world = TopologyWorld(10, reach=reach, auto=True)
    world.run(100.0)
    assert len(world.links()) == MAX_LINKS
    out = [f"r{i}" for i in range(1, 10) if ("r0", f"r{i}") not in world.links()]
    assert len(out) == 2
    why = dict.fromkeys(out, "not called, this robot has all its 7 links")
    assert world.linking("r0").missing == why
    # Nobody but the hub can call them; once it has room, it does.
    gone = next(b for _, b in world.links())
    world.kill(gone)
    world.run(100.0)
    assert len(world.links()) == MAX_LINKS


def test_auto_can_be_set_and_unset_while_it_runs() -> None:
    world = TopologyWorld(6, list(combinations(names_of(6), 2)))
    world.run(3.0)
    world.change("r2", "auto")
    world.run(30.0)
    assert world.agreed().auto
    assert len(world.links()) < 15
    assert nx.is_biconnected(world.graph())
    world.change("r5", "line")
    world.run(20.0)
    assert (world.agreed().auto, world.agreed().version) == (False, 2)
    assert world.links() == {(f"r{i}", f"r{i + 1}") for i in range(5)}


class Mending(RuleBasedStateMachine):
    """Robots go, come back, do not hear each other, in any order; in the end the swarm is whole, or says why not."""

    @initialize(seed=st.integers(0, 99), n=st.integers(3, 7), data=st.data())
    def begin(self, seed: int, n: int, data: st.DataObject) -> None:
        self.names = names_of(n)
        self.reach = data.draw(reaches(n))
        self.world = TopologyWorld(n, reach=self.reach, auto=True, seed=seed, jitter=0.01)
        self.world.gentle = False

    @rule(place=st.integers(0, 6), leave=st.booleans())
    def go_or_come(self, place: int, leave: bool) -> None:
        name = self.names[place % len(self.names)]
        if name not in self.world.bots:
            self.world.start(name)
        elif leave:
            self.world.leave(name)
        else:
            self.world.kill(name)

    @rule(part=st.sets(st.integers(0, 6), min_size=1))
    def partition(self, part: set[int]) -> None:
        for a, b in combinations(self.names, 2):
            if (self.names.index(a) in part) != (self.names.index(b) in part):
                self.world.cut(a, b)

    @rule(pair=st.tuples(st.integers(0, 6), st.integers(0, 6)), silent=st.booleans())
    def cut(self, pair: tuple[int, int], silent: bool) -> None:
        a, b = (self.names[place % len(self.names)] for place in pair)
        if a != b:
            self.world.cut(a, b, silent=silent)

    @rule()
    def heal(self) -> None:
        self.world.blocked.clear()

    @rule(seconds=st.sampled_from([0.1, 1.0, 5.0, 60.0, 300.0]))
    def wait(self, seconds: float) -> None:
        self.world.run(seconds)

    @invariant()
    def nobody_has_too_many_links(self) -> None:
        if hasattr(self, "world"):
            assert max((degree for _, degree in self.world.graph().degree), default=0) <= MAX_LINKS

    def teardown(self) -> None:
        if hasattr(self, "world"):
            self.world.run(FOUND_S)
            check(self.world, self.reach)
            self.world.blocked.clear()
            for name in self.names:
                if name not in self.world.bots:
                    self.world.start(name)
            self.world.run(FOUND_S)
            check(self.world, self.reach)


TestMending = Mending.TestCase
TestMending.settings = settings(max_examples=examples(25), stateful_step_count=15, deadline=None)

pytestmark = pytest.mark.timeout(300)
