"""Who is there, as robots see it while links and processes come and go; and the whole swarm as one robot knows it."""

from collections.abc import Sequence

from conftest import costly
from hypothesis import example, given
from hypothesis import strategies as st
from overlay_world import SILENCE, World, full, line, ring, thesis_d
from stop_world import NOTICED, arm, stop, stopped

from services.mesh.core.overlays.stop import REPEAT_PERIOD
from services.mesh.core.routing import membership
from services.mesh.core.routing.membership import PAGE, Membership, Survey
from swarm.messages.codec import MAX_PAYLOAD, encode

GRAPHS = {"line": line(6), "loop": ring(6), "thesis-d": thesis_d(), "full": full(4)}


def test_robots_that_start_join_the_members() -> None:
    world = World(line(4), start=False)
    world.start("r0")
    world.run(1.0)
    assert set(world.states("r0").values()) == {"never"}
    for name in world.names[1:]:
        world.start(name)
        world.run(NOTICED)
    assert set(world.states("r0").values()) == {"here"}
    assert world.changes("r0") == [("r1", "join"), ("r2", "join"), ("r3", "join")]
    members = {each.robot: each for each in world.bots["r0"].overlays.members(world.now).members}
    assert [(each.hops, each.via) for each in members.values()] == [(1, "r1"), (2, "r1"), (3, "r1")]


def test_leaving_is_told_from_crashing() -> None:
    world = World(full(5))
    world.settle()
    world.leave("r2")
    world.run(NOTICED)
    world.kill("r4")
    world.run(NOTICED)
    for name in ("r0", "r1", "r3"):
        assert world.changes(name)[-2:] == [("r2", "leave"), ("r4", "crash")]
        assert world.states(name)["r2"] == "left"
        assert world.states(name)["r4"] == "gone"


def test_a_robot_returns_as_a_new_one() -> None:
    world = World(ring(5))
    world.settle()
    for end in (world.kill, world.leave):
        end("r2")
        world.run(NOTICED)
        world.start("r2")
        world.run(NOTICED)
        for name in ("r0", "r1", "r3", "r4"):
            assert world.changes(name)[-1] == ("r2", "return")
            assert world.states(name)["r2"] == "here"


def test_a_quick_restart_is_noticed() -> None:
    world = World(full(4))
    world.settle()
    world.kill("r2")
    world.start("r2")
    world.run(NOTICED)
    for name in ("r0", "r1", "r3"):
        assert world.changes(name)[-1] in (("r2", "restart"), ("r2", "return"))


def test_a_partition_and_its_end_are_told_on_both_sides() -> None:
    world = World(line(4))
    world.settle()
    world.cut("r1", "r2")
    world.run(NOTICED)
    assert world.changes("r0")[-2:] == [("r2", "partition"), ("r3", "partition")]
    assert world.changes("r3")[-2:] == [("r0", "partition"), ("r1", "partition")]
    assert world.states("r0") == {"r1": "here", "r2": "gone", "r3": "gone"}
    world.join("r1", "r2")
    world.run(NOTICED)
    assert world.changes("r0")[-2:] == [("r2", "heal"), ("r3", "heal")]
    assert set(world.states("r3").values()) == {"here"}


def test_silence_is_noticed_when_the_link_notices_it() -> None:
    world = World(line(3))
    world.settle()
    world.cut("r1", "r2", silent=True)
    world.run(SILENCE - 0.1)
    assert world.states("r0")["r2"] == "here"
    world.run(NOTICED)
    assert world.changes("r0")[-1] == ("r2", "crash")


def test_changes_are_kept_but_not_without_end() -> None:
    world = World(line(2))
    world.settle()
    for _ in range(membership.KEPT_CHANGES):
        world.cut("r0", "r1")
        world.run(NOTICED)
        world.join("r0", "r1")
        world.run(NOTICED)
    assert len(world.changes("r0")) == membership.KEPT_CHANGES


steps_of = st.lists(
    st.one_of(
        st.tuples(st.just("cut"), st.integers(0, 20), st.integers(0, 1)),
        st.tuples(st.just("join"), st.integers(0, 20), st.just(0)),
        st.tuples(st.just("restart"), st.integers(0, 5), st.integers(0, 1)),
        st.tuples(st.just("stop"), st.integers(0, 5), st.just(0)),
        st.tuples(st.just("arm"), st.integers(0, 5), st.just(0)),
        st.tuples(st.just("wait"), st.floats(0.001, 1.5), st.just(0)),
    ),
    max_size=40,
)


@costly(100)
@given(steps_of, st.sampled_from(sorted(GRAPHS)), st.integers(0, 99))
@example(
    # Two pairs of the latest values of r1 differed in both numbers by the same bits.
    [("restart", 0, 0), ("stop", 0, 0), ("stop", 1, 0), ("wait", 0.125, 0), ("cut", 2, 0)],
    "line",
    0,
)
def test_in_the_end_all_agree_who_is_there_and_whether_to_stand_still(
    steps: Sequence[tuple[str, float, int]], graph: str, seed: int
) -> None:
    world = World(GRAPHS[graph], seed=seed)
    world.run(1.0)
    edges = [sorted(edge) for edge in world.edges]
    for what, value, option in steps:
        name = world.names[int(value) % len(world.names)]
        match what:
            case "cut":
                world.cut(*edges[int(value) % len(edges)], silent=bool(option))
            case "join":
                world.join(*edges[int(value) % len(edges)])
            case "restart":
                (world.leave if option else world.kill)(name)
                world.start(name)
            case "stop":
                stop(world, name)
            case "arm":
                arm(world, name)
            case "wait":
                world.run(value)
    world.run(5.0)
    reachable = {name: {name} for name in world.names}
    for edge, state in world.edges.items():
        if state.up:
            a, b = edge
            union = reachable[a] | reachable[b]
            for name in union:
                reachable[name] = union
    for name in world.names:
        here = {robot for robot, state in world.states(name).items() if state == "here"}
        assert here == reachable[name] - {name}
    for edge in world.edges:
        world.join(*sorted(edge))
    world.run(REPEAT_PERIOD + 2.0)
    for name in world.names:
        assert set(world.states(name).values()) == {"here"}
    assert len({bool(stopped(world, name).by) for name in world.names}) == 1
    # Whatever was before, somebody who sees the whole swarm can arm it, and stop it again.
    arm(world, "r0")
    world.run(NOTICED)
    assert not any(stopped(world, name).stopped for name in world.names)
    stop(world, "r1")
    world.run(NOTICED)
    assert all(stopped(world, name).stopped for name in world.names)


def test_each_robot_knows_the_whole_graph() -> None:
    world = World(thesis_d())
    world.run(8.0)
    for name in world.names:
        graph = world.bots[name].overlays.graph(world.now)
        assert not graph.more
        found = {frozenset((each.robot, peer)) for each in graph.robots for peer in each.links}
        assert found == set(world.edges)
        (own,) = (each for each in graph.robots if each.state == "self")
        assert (own.robot, own.hops, own.via) == (name, 0, None)
        assert all(each.hops in (1, 2) and each.state == "here" for each in graph.robots if each is not own)
    world.kill("r5")
    world.run(NOTICED)
    (gone,) = (each for each in world.bots["r2"].overlays.graph(world.now).robots if each.robot == "r5")
    assert (gone.state, gone.hops, gone.via) == ("gone", None, None)


class ManyLinks:
    """A map in which every robot has sixteen links, more than any radio has."""

    def __init__(self, names: list[str]) -> None:
        self._names = names

    def links(self, name: str) -> dict[str, int]:
        at = self._names.index(name)
        return {self._names[(at + step) % len(self._names)]: 300 for step in range(1, 17)}


def test_a_large_graph_comes_in_pages_that_fit_the_bus() -> None:
    names = [f"a-long-name-{n:04}" for n in range(2 * PAGE + 50)]
    survey = Survey(names[7], names, Membership(names[7], names, dict), ManyLinks(names), lambda name: 0)  # type: ignore[arg-type]
    found: list[str] = []
    more, after = True, ""
    while more:
        page = survey.graph(1e6, stopped=True, after=after)
        assert len(encode(page)) < MAX_PAYLOAD
        found += [each.robot for each in page.robots]
        more, after = page.more, page.robots[-1].robot
    assert found == names
