"""Floods of which all are to know that all have them: how soon each robot knows, by how many messages, and after what
accidents."""

from collections import deque
from collections.abc import Iterable

import pytest
from conftest import costly
from hypothesis import example, given
from hypothesis import strategies as st
from overlay_world import GRAPHS, World, line, ring

from services.mesh.core.overlays import completion
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import BULK, FLOOD
from services.mesh.core.wire.packets import Spread
from swarm.messages import Flooded
from swarm.messages.codec import decode

LATENCY = 0.03
Edges = Iterable[tuple[str, str]]


def hops(edges: Edges, start: str) -> dict[str, int]:
    found, queue = {start: 0}, deque((start,))
    while queue:
        name = queue.popleft()
        for edge in edges:
            if name in edge:
                (peer,) = set(edge) - {name}
                if peer not in found:
                    found[peer] = found[name] + 1
                    queue.append(peer)
    return found


def least_hops(edges: Edges, origin: str) -> int:
    """No robot can know sooner that all have a flood: the largest d(origin, v) + d(v, u)."""
    out = hops(edges, origin)
    return max(out[v] + back for v in out for back in hops(edges, v).values())


def settled(edges: Edges, **options: float) -> World:
    """A world whose links are known to all; counts the messages of announced floods under 1."""
    world = World(edges, **options)  # type: ignore[arg-type]
    world.settle()
    world.counting = lambda packet: int(
        packet.overlay == FLOOD
        and (
            packet.payload[0] == packets.KNOWN
            or (packet.payload[0] == packets.SPREAD and packets.decode_spread(packet.payload).known > 0)
        )
    )
    return world


def knew(world: World, origin: str) -> dict[str, float]:
    """When each robot has learned that all have a flood of that robot, once."""
    found: dict[str, float] = {}
    for name, bot in world.bots.items():
        for (key, payload), t in zip(bot.inbox, bot.times, strict=True):
            if key == f"swarm/{origin}/mesh/flooded" and decode(Flooded, payload, key).complete:
                assert name not in found, f"{name} was told twice"
                found[name] = t
    return found


@pytest.mark.parametrize("graph", GRAPHS)
@pytest.mark.parametrize("origin", ["r0", "r2", "r5"])
def test_all_know_as_soon_as_they_can_by_at_most_4e_messages(graph: str, origin: str) -> None:
    world = settled(GRAPHS[graph])
    began = world.now
    ticket = world.flood(origin, b"x", announce=True)
    world.run(1.0)
    found = knew(world, origin)
    assert found.keys() == set(world.names)
    assert max(found.values()) - began == pytest.approx(least_hops(GRAPHS[graph], origin) * LATENCY)
    assert world.messages[1] <= 4 * len(GRAPHS[graph])
    answer = world.flooded(origin, ticket)
    assert answer is not None
    assert answer.robots == tuple(name for name in world.names if name != origin)


@pytest.mark.parametrize(("origin", "ms", "messages"), [("r0", 300, 10), ("r2", 240, 15)])
def test_on_a_line_of_six(origin: str, ms: int, messages: int) -> None:
    world = settled(line(6))
    began = world.now
    world.flood(origin, b"x", announce=True)
    world.run(1.0)
    assert 1e3 * (max(knew(world, origin).values()) - began) == pytest.approx(ms)
    assert world.messages[1] == messages


def test_who_hears_it_has_had_the_message() -> None:
    world = settled(line(4))
    world.flood("r1", b"x", announce=True)
    world.run(1.0)
    for name in ("r0", "r2", "r3"):
        assert [key.split("/")[-1] for key, _ in world.bots[name].inbox] == ["flood", "flooded"]
        (told,) = world.got(name, "r1/mesh/flooded")
        assert decode(Flooded, told, "") == Flooded(
            decode(Flooded, told, "").t, "", "test", ("r0", "r2", "r3"), complete=True, problem=""
        )


def test_without_it_nobody_else_is_told() -> None:
    world = settled(line(4))
    world.flood("r1", b"y")
    world.run(1.0)
    assert [len(world.got(name, "mesh/flooded")) for name in world.names] == [0, 1, 0, 0]


def test_a_large_one_is_known_to_be_everywhere_when_the_last_robot_has_all_of_it() -> None:
    world = settled(line(4))
    world.flood("r0", bytes(20_000), announce=True, priority="bulk")
    world.run(20.0)
    found = knew(world, "r0")
    assert found.keys() == set(world.names)
    last = world.bots["r3"]
    assert min(found.values()) >= last.times[[key.endswith("/flood") for key, _ in last.inbox].index(True)]


def test_alone_all_know_at_once() -> None:
    world = World(line(2), start=False)
    world.start("r0")
    answer = world.flooded("r0", world.flood("r0", b"x", announce=True))
    assert answer is not None
    assert (answer.robots, answer.complete) == ((), True)


def test_a_robot_that_dies_meanwhile_is_not_waited_for() -> None:
    world = settled(line(5))
    world.flood("r0", b"x", announce=True)
    world.run(0.05)  # r1 has it, r2 has not
    world.kill("r4")
    world.run(5.0)
    assert knew(world, "r0").keys() == {"r0", "r1", "r2", "r3"}


def test_a_link_that_breaks_meanwhile_is_gone_around() -> None:
    world = settled(ring(6))
    world.flood("r0", b"x", announce=True)
    world.run(0.095)
    world.cut("r3", "r4")
    world.run(5.0)
    assert knew(world, "r0").keys() == set(world.names)


def test_a_second_try_reaches_those_whom_the_first_one_missed_and_tells_nobody_twice() -> None:
    world = settled(line(4))
    ticket = world.flood("r0", b"x", announce=True)
    world.run(0.05)  # r1 has it, r2 has not
    world.cut("r1", "r2")
    world.join("r1", "r2")
    world.run(10.0)
    answer = world.flooded("r0", ticket)
    assert answer is not None
    assert answer.robots == ("r1", "r2", "r3")
    assert world.bots["r0"].counters["flood_retries"] == 1
    assert knew(world, "r0").keys() == set(world.names)
    for name in ("r1", "r2", "r3"):
        assert world.got(name, "/flood") == [b"x"]


def test_a_silent_robot_makes_it_incomplete_in_the_end_and_nobody_claims_more() -> None:
    world = settled(line(3))
    world.edges[frozenset(("r1", "r2"))].alive = False  # and nobody ever notices
    ticket = world.flood("r0", b"x", announce=True)
    world.run(30.0)
    answer = world.flooded("r0", ticket)
    assert answer is not None
    assert (answer.complete, answer.robots) == (False, ())
    assert not knew(world, "r0")


def test_strangers_are_refused_and_nothing_grows_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(completion, "MAX_WAVES", 10)
    world = settled(line(3))
    key = "swarm/r1/app/test/flood"
    strange = packets.encode_spread(Spread(2**62, 1, b"x", known=1 << 9))
    world.step("r0", lambda each: each.receive("r1", FLOOD, key, strange, BULK, world.now))
    assert world.bots["r0"].counters["bad_packets"] == 1
    for sequence in range(2, 100):
        data = packets.encode_spread(Spread(2**62, sequence, b"x", known=2))
        world.step("r0", lambda each, data=data: each.receive("r1", FLOOD, key, data, BULK, world.now))  # type: ignore[misc]
    known = world.bots["r0"].overlays._flood._completion
    assert len(known) == 10
    world.run(120.0)
    assert not len(known)


# -- any graph, any accidents ----------------------------------------------------------------------------------


@st.composite
def graphs(draw: st.DrawFn) -> list[tuple[str, str]]:
    """A connected graph of 2 to 9 robots."""
    count = draw(st.integers(2, 9))
    edges = {(draw(st.integers(0, robot - 1)), robot) for robot in range(1, count)}
    pairs = [(a, b) for b in range(count) for a in range(b)]
    edges |= set(draw(st.lists(st.sampled_from(pairs), max_size=2 * count)))
    return [(f"r{a}", f"r{b}") for a, b in sorted(edges)]


CIRCLE = [("r0", "r1"), ("r0", "r3"), ("r0", "r6"), ("r1", "r2"), ("r1", "r7"), ("r2", "r4"), ("r2", "r8"),
          ("r3", "r5"), ("r3", "r7"), ("r4", "r5")]  # fmt: skip
"""Robots that wait until they know of all who have a shortest way over them wait for one another here."""


@costly(60)
@given(graphs(), st.integers(0, 8), st.sampled_from((0.0, 0.02)), st.integers(0, 99))
@example(CIRCLE, 0, 0.0, 0)
def test_on_any_graph_all_know_without_a_second_try_by_at_most_4e_messages(
    edges: list[tuple[str, str]], number: int, jitter: float, seed: int
) -> None:
    world = settled(edges, jitter=jitter, seed=seed)
    origin = world.names[number % len(world.names)]
    began = world.now
    world.flood(origin, b"x", announce=True)
    world.run(3.0)
    found = knew(world, origin)
    assert found.keys() == set(world.names)
    assert world.messages[1] <= 4 * len(edges)
    if len(edges) == len(world.names) - 1 and not jitter:
        assert max(found.values()) - began == pytest.approx(least_hops(edges, origin) * LATENCY)


accidents = st.lists(
    st.one_of(
        st.tuples(st.just("flood"), st.integers(0, 9)),
        st.tuples(st.just("cut"), st.integers(0, 30)),
        st.tuples(st.just("join"), st.integers(0, 30)),
        st.tuples(st.just("restart"), st.integers(0, 9)),
        st.tuples(st.just("wait"), st.sampled_from((0.01, 0.03, 0.1, 1.0))),
    ),
    max_size=30,
)


@costly(60)
@given(graphs(), accidents, st.integers(0, 99))
def test_whatever_happens_nobody_is_told_of_what_is_not_so_and_later_floods_are_known_again(
    edges: list[tuple[str, str]], steps: list[tuple[str, float]], seed: int
) -> None:
    world = settled(edges, seed=seed)
    pairs = [sorted(edge) for edge in world.edges]
    asked = []
    for count, (what, value) in enumerate(steps):
        name = world.names[int(value) % len(world.names)]
        match what:
            case "flood":
                asked.append((name, world.flood(name, b"%d" % count, announce=True)))
            case "cut":
                world.cut(*pairs[int(value) % len(pairs)])
            case "join":
                world.join(*pairs[int(value) % len(pairs)])
            case "restart":
                world.kill(name)
                world.start(name)
                asked = [each for each in asked if each[0] != name]
            case _:
                world.run(value)
    world.run(10.0)
    for name, ticket in asked:
        answer = world.flooded(name, ticket)
        assert answer is not None
        if answer.complete and "restart" not in {what for what, _ in steps}:
            payload = b"%d" % [at for at, step in enumerate(steps) if step[0] == "flood"][int(ticket[1:])]
            assert all(payload in world.got(other, f"{name}/app/test/flood") for other in answer.robots)
    for pair in pairs:
        world.join(*pair)
    world.run(10.0)
    world.clear()
    for name in world.names:
        world.flood(name, b"end", announce=True)
        world.run(3.0)
        assert knew(world, name).keys() == set(world.names)


def test_the_tree_has_no_link_of_which_one_end_alone_tells() -> None:
    links = {"r0": {"r1", "r2"}, "r2": {"r0", "r1", "r3"}, "r3": {"r1", "r2"}}
    assert completion._tree(links, "r0") == {"r0": {"r2"}, "r1": set(), "r2": {"r0", "r3"}, "r3": {"r2"}}
