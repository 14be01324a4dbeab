"""Topology at run time: versions, make before break, who was away; and what is kept of it."""

from itertools import combinations, pairwise

import networkx as nx
import pytest
from conftest import costly, examples
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from overlay_world import line, ring
from topology_world import TopologyWorld, names_of

from services.mesh.core.routing.topology import MAX_LINKS, Ground, TopologyVersion
from swarm.core.graph import Graph
from swarm.errors import FrameError, LocalError
from swarm.messages import TopologyRequest, TopologySet
from swarm.messages.codec import decode

FIVE = names_of(5)
SIX = names_of(6)


def graph_of(n: int, pairs: list[tuple[int, int]]) -> "nx.Graph[int]":
    graph: nx.Graph[int] = nx.Graph()
    graph.add_nodes_from(range(n))
    graph.add_edges_from(pairs)
    return graph


@st.composite
def topologies(draw: st.DrawFn, n: int) -> list[tuple[str, str]]:
    """Connected, at most seven links a robot."""
    order = draw(st.permutations(range(n)))
    pairs = {(min(a, b), max(a, b)) for a, b in pairwise(order)}
    pairs |= set(draw(st.lists(st.sampled_from(sorted(combinations(range(n), 2))), max_size=n)))
    return [(f"r{a}", f"r{b}") for a, b in sorted(pairs)]


# -- the value ---------------------------------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1), st.sampled_from(SIX), st.booleans(), topologies(6))
def test_a_value_survives_wire_and_file(
    version: int, step: int, issuer: str, auto: bool, edges: list[tuple[str, str]]
) -> None:
    ground = Ground(SIX, line(6), auto=False)
    value = TopologyVersion(version, step, issuer, auto or not version, Graph(SIX, edges).edges)
    assert ground.decode(ground.encode(value)) == value
    assert ground.from_file(ground.to_file(value)) == value
    assert Ground(SIX, ring(6), auto=False).decode(ground.encode(value)) is None
    assert 0 < ground.tag(value) < 2**32


def test_a_topology_has_these_bytes() -> None:
    ground = Ground(["r0", "r1", "r2"], line(3), auto=False)
    assert ground.base == 0x4E2800DF
    value = TopologyVersion(3, 1, "r2", True, (("r0", "r1"), ("r0", "r2")))
    expected = "06 01 df 00 28 4e 03 00 00 00 01 00 00 00 02 72 32 02 01 00 02 00 00 00"
    assert ground.encode(value).hex(" ") == expected
    base, robot, edge = 17, 1, 2  # as docs/explanation/topology.md has it, for an issuer's name of two letters
    assert len(ground.encode(value)) == base + robot * len(ground.names) + edge * len(value.edges)
    assert ground.tag(ground.first) == 0


@given(st.binary(max_size=60), st.integers(0, 30), st.integers(0, 255))
def test_no_bytes_do_harm(noise: bytes, place: int, byte: int) -> None:
    ground = Ground(SIX, line(6), auto=False)
    good = ground.encode(TopologyVersion(3, 0, "r1", False, Graph(SIX, ring(6)).edges))
    bad = bytearray(good)
    bad[place % len(bad)] = byte
    for data in (noise, bytes(bad), good[:-1], good + b"\0", b"\x06\x00" + good[2:6] + noise):
        try:
            value = ground.decode(data)
        except FrameError:
            continue
        if value is not None:
            assert ground.encode(value) == data
            assert all(Graph(SIX, value.edges).degree(name) <= MAX_LINKS for name in SIX)
    for data in (noise, bytes(bad), ground.to_file(ground.first)[:-1]):
        with pytest.raises(FrameError):
            ground.from_file(data)


@pytest.mark.parametrize(
    ("shape", "edges", "problem"),
    [
        ("star", (), "expected line, loop, full, thesis-d or random:SEED, got 'star'"),
        ("", (("r0", "r9"),), "link r0-r9: there is no robot 'r9'"),
        ("", (("r0", "r1"), ("r2", "r3"), ("r4", "r5")), "these parts could not reach each other: r0 r1; r2 r3; r4 r5"),
        ("", (("r0", "r0"),), "a robot is not linked to itself"),
        ("", (("r0", "r1"), ("r1", "r0")), "listed twice"),
        ("", (("r0", "r1", "r2"),), "a link has two ends"),
    ],
)
def test_what_cannot_be_a_topology_is_refused_with_a_reason(
    shape: str, edges: tuple[tuple[str, ...], ...], problem: str
) -> None:
    with pytest.raises(LocalError, match=problem):
        Ground(SIX, line(6), auto=False).edges_of(shape, edges)


def test_nobody_gets_more_than_seven_links() -> None:
    names = names_of(9)
    ground = Ground(names, line(9), auto=False)
    with pytest.raises(LocalError, match="r0 would have 8 links, a robot has at most 7"):
        ground.edges_of("full", ())
    # The configuration may say so where radios allow it.
    assert Ground(names, list(combinations(names, 2)), auto=False).first.edges


# -- setting it --------------------------------------------------------------------------------------------------------


def answers(world: TopologyWorld, name: str) -> list[TopologySet]:
    return [decode(TopologySet, data, "") for data in world.got(name, f"{name}/mesh/topology_set")]


def test_what_one_robot_sets_holds_everywhere() -> None:
    world = TopologyWorld(6, line(6))
    world.run(3.0)
    assert world.links() == set(line(6))
    assert world.agreed() == world.ground.first
    world.change("r3", "loop")
    world.run(0.2)
    assert world.agreed()[:4] == (1, 0, "r3", False)
    world.run(3.0)
    assert world.links() == set(Graph(SIX, ring(6)).edges)
    world.change("r0", "", [("r0", f"r{i}") for i in range(1, 6)])
    world.run(5.0)
    assert world.agreed().version == 2
    assert world.links() == {("r0", f"r{i}") for i in range(1, 6)}
    assert [answer.problem for name in ("r3", "r0") for answer in answers(world, name)] == ["", ""]
    assert all(world.linking(name).kept == () for name in SIX)
    assert all(set(world.linking(name).up) == world.linking(name).wanted for name in SIX)


def test_a_wrong_wish_changes_nothing_and_says_why() -> None:
    world = TopologyWorld(6, line(6))
    world.run(3.0)
    world.change("r1", "star")
    world.change("r1", "loop", after=3)
    world.change("r1", "loop", after=0)
    world.change("r1", "line", after=0)
    problems = [(answer.version, answer.problem) for answer in answers(world, "r1")]
    assert problems[0][0] == 0
    assert "got 'star'" in problems[0][1]
    assert problems[1] == (0, "version 0 is in force, not 3: look at it (swarm mesh topology show) and set again")
    assert problems[2] == (1, "")
    assert problems[3][1].startswith("version 1 is in force, not 0")


def test_a_repeated_request_is_answered_again_and_done_once() -> None:
    world = TopologyWorld(3, line(3))
    world.run(3.0)
    request = TopologyRequest("once", "loop", (), None)
    for _ in range(3):
        world.step("r0", lambda overlays: overlays.request(request, world.now))
    assert [answer.version for answer in answers(world, "r0")] == [1, 1, 1]


def test_two_sets_at_once_end_alike() -> None:
    world = TopologyWorld(6, line(6))
    world.run(3.0)
    world.change("r0", "loop")
    world.change("r5", "full")
    world.run(15.0)
    assert world.agreed()[:3] == (1, 0, "r5")
    assert world.links() == set(combinations(SIX, 2))


def test_who_was_away_gets_it_even_if_its_issuer_is_gone() -> None:
    world = TopologyWorld(6, line(6))
    world.run(3.0)
    world.kill("r5")
    world.change("r0", "", [("r1", "r2"), ("r2", "r3"), ("r3", "r4"), ("r0", "r2"), ("r0", "r5")])
    world.run(200.0)  # link states of r5 have been forgotten
    world.kill("r0")
    world.run(200.0)
    # r0 alone is its neighbour in the new topology, and r5 does not even know that; r4 looks for it.
    world.start("r5")
    world.run(70.0)
    assert world.value("r5").version == 1
    assert nx.is_connected(world.graph())
    world.start("r0")
    world.run(20.0)
    assert world.agreed().version == 1
    assert world.links() == set(world.agreed().edges)


def test_a_link_that_alone_holds_the_swarm_together_stays() -> None:
    """Nobody can hear r3 but r2: the new topology cannot be."""
    reach = [*line(4), ("r0", "r2")]
    world = TopologyWorld(4, line(4), reach=reach)
    world.run(3.0)
    world.change("r1", "", [("r1", "r0"), ("r0", "r2"), ("r0", "r3")])
    world.run(120.0)
    assert world.agreed().version == 1
    assert world.links() == {("r0", "r1"), ("r0", "r2"), ("r2", "r3")}
    assert world.linking("r2").kept == ("r3",)
    # So it can still be told a better one.
    world.change("r0", "line")
    world.run(5.0)
    assert world.agreed().version == 2
    assert world.links() == set(line(4))


def test_a_robot_with_another_configuration_stays_out() -> None:
    world = TopologyWorld(4, line(4))
    world.kill("r3")
    world.run(2.0)
    other = TopologyWorld(4, ring(4), start=False)
    world.ground, mine = other.ground, world.ground
    world.start("r3")
    world.ground = mine
    world.run(5.0)
    # r2-r3 is a link of both; r0-r3 only of r3's.
    assert ("r0", "r3") not in world.links()
    world.change("r3", "full")
    world.run(5.0)
    assert world.value("r0").version == 0
    assert world.bots["r2"].counters["topology_foreign"]


@costly(25)
@given(data=st.data(), n=st.integers(2, 8), seed=st.integers(0, 99))
def test_changes_never_split_the_swarm_nor_lose_a_message(data: st.DataObject, n: int, seed: int) -> None:
    """Sets at any robot and any time, while everybody floods and sends."""
    world = TopologyWorld(n, data.draw(topologies(n)), jitter=0.01, seed=seed)
    world.run(3.0)
    names = names_of(n)
    assert world.links() == set(world.ground.first.edges)
    world.slow = data.draw(st.sampled_from([0.0, 3.0, 15.0]))
    floods, sends = [], []
    for _ in range(data.draw(st.integers(1, 4))):
        world.change(data.draw(st.sampled_from(names)), "", data.draw(topologies(n)))
        for _ in range(data.draw(st.integers(1, 30))):
            origin, to = data.draw(st.sampled_from(names)), data.draw(st.sampled_from(names))
            floods.append((origin, world.flood(origin, f"flood {len(floods)}".encode())))
            if to != origin:
                sends.append((origin, to, world.send(origin, to, f"send {len(sends)}".encode())))
            world.run(0.1)
            assert nx.is_connected(world.graph())
    world.run(60.0)
    value = world.agreed()
    assert value == max(world.values)
    assert world.links() == set(value.edges)
    for number, (origin, ticket) in enumerate(floods):
        flooded = world.flooded(origin, ticket)
        assert flooded is not None
        for name in names:
            if name != origin:
                assert world.got(name, f"{origin}/app/test/flood").count(f"flood {number}".encode()) == 1
    for number, (origin, to, ticket) in enumerate(sends):
        sent = world.sent(origin, ticket)
        assert sent is not None
        assert sent.delivered
        assert world.got(to, f"{origin}/app/test/send/{to}").count(f"send {number}".encode()) == 1


class Machine(RuleBasedStateMachine):
    """Sets, cuts, kills, restarts, partitions, in any order. In the end all have the highest version, and its links."""

    @initialize(edges=topologies(5), seed=st.integers(0, 99), slow=st.sampled_from([0.0, 3.0]))
    def begin(self, edges: list[tuple[str, str]], seed: int, slow: float) -> None:
        self.world = TopologyWorld(5, edges, jitter=0.01, seed=seed, slow=slow)
        self.world.gentle = False  # what links failed may have been the other way
        self.highest = (0, 0, "")

    def note(self) -> None:
        self.highest = max([self.highest, *(self.world.value(name)[:3] for name in self.world.bots)])

    @rule(name=st.sampled_from(FIVE), edges=topologies(5))
    def change(self, name: str, edges: list[tuple[str, str]]) -> None:
        if name in self.world.bots:
            self.world.change(name, "", edges)
            self.note()

    @rule(name=st.sampled_from(FIVE))
    def kill_or_start(self, name: str) -> None:
        if name in self.world.bots:
            self.world.kill(name)
        else:
            self.world.start(name)

    @rule(name=st.sampled_from(FIVE))
    def restart(self, name: str) -> None:
        if name in self.world.bots:
            self.world.kill(name)
            self.world.start(name)

    @rule(pair=st.sampled_from(sorted(combinations(FIVE, 2))), silent=st.booleans())
    def cut(self, pair: tuple[str, str], silent: bool) -> None:
        self.world.cut(*pair, silent=silent)

    @rule(pair=st.sampled_from(sorted(combinations(FIVE, 2))))
    def join(self, pair: tuple[str, str]) -> None:
        self.world.join(*pair)

    @rule(part=st.sets(st.sampled_from(FIVE), min_size=1, max_size=4))
    def partition(self, part: set[str]) -> None:
        for a, b in combinations(FIVE, 2):
            if (a in part) != (b in part):
                self.world.cut(a, b)

    @rule(seconds=st.sampled_from([0.05, 0.3, 2.0, 15.0, 40.0, 200.0]))
    def wait(self, seconds: float) -> None:
        self.world.run(seconds)

    @invariant()
    def versions_go_up(self) -> None:
        if hasattr(self, "world"):
            for name, bot in self.world.bots.items():
                assert bot.overlays.linking is not None
                assert bot.overlays.linking.value >= self.world.saved.get(name, self.world.ground.first)

    def teardown(self) -> None:
        if not hasattr(self, "world"):
            return
        self.world.blocked.clear()
        for name in FIVE:
            if name not in self.world.bots:
                self.world.start(name)
        self.world.run(120.0)
        value = self.world.agreed()
        assert value[:3] == self.highest
        assert self.world.links() == set(value.edges)


TestMachine = Machine.TestCase
TestMachine.settings = settings(max_examples=examples(40), stateful_step_count=25, deadline=None)
