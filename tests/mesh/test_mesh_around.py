"""Around a silent link: over other robots, along the shortest way that does not use it."""

import networkx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from overlay_world import World, full, line, ring, thesis_d

from services.mesh.core.overlays import around
from services.mesh.core.overlays.around import AROUND, Packet
from services.mesh.core.wire.frames import SYNC, UNICAST
from swarm.errors import FrameError

KEY = "swarm/r0/app/x/sync/c/r1/around"
names = st.from_regex(r"[a-z][a-z0-9_-]{0,15}", fullmatch=True)


def settled(edges: list[tuple[str, str]]) -> World:
    world = World(edges)
    world.settle()
    return world


def go_around(world: World, sender: str, to: str, key: str = KEY, payload: bytes = b"hello") -> None:
    world.step(sender, lambda overlays: overlays.go_around(to, key, payload, SYNC, world.now))


def counted(world: World, what: str) -> int:
    return sum(bot.counters[f"around_{what}"] for bot in world.bots.values())


@pytest.mark.parametrize("edges", [ring(6), full(6), thesis_d()], ids=("loop", "full", "thesis-d"))
def test_it_takes_the_shortest_way_without_the_link(edges: list[tuple[str, str]]) -> None:
    world = settled(edges)
    for sender, to in sorted(edges):
        world.clear()
        graph = networkx.Graph(edges)
        graph.remove_edge(sender, to)
        hops = networkx.shortest_path_length(graph, sender, to) if networkx.has_path(graph, sender, to) else 0
        began = world.now
        go_around(world, sender, to, KEY.replace("r0", sender))
        world.run(1.0)
        assert world.messages[UNICAST] == hops
        assert world.bots[to].times == ([pytest.approx(began + hops * 0.03)] if hops else [])


def test_it_arrives_while_the_link_swallows_everything() -> None:
    world = settled(ring(6))
    world.cut("r0", "r1", silent=True)
    go_around(world, "r0", "r1")
    world.run(0.2)
    assert world.bots["r1"].inbox == [(KEY, b"hello")]


def test_it_arrives_when_the_link_has_been_given_up() -> None:
    world = settled(ring(6))
    world.cut("r0", "r1")
    world.settle()
    go_around(world, "r0", "r1")
    world.run(0.2)
    assert world.bots["r1"].inbox == [(KEY, b"hello")]


def test_on_a_line_there_is_no_way() -> None:
    world = settled(line(3))
    go_around(world, "r0", "r1")
    world.run(1.0)
    assert (world.messages[UNICAST], counted(world, "no_way"), counted(world, "sent")) == (0, 1, 0)


def test_a_new_link_is_a_new_way() -> None:
    world = World([*line(3), ("r0", "r2")], start=True)
    world.settle()
    world.cut("r0", "r2")
    world.settle()
    go_around(world, "r0", "r1")
    world.join("r0", "r2")
    world.run(2.0)
    assert counted(world, "no_way") == 1
    go_around(world, "r0", "r1")
    world.run(0.2)
    assert world.bots["r1"].inbox == [(KEY, b"hello")]
    assert counted(world, "forwarded") == 1


def test_what_no_rule_lets_in_is_refused() -> None:
    world = settled(ring(4))
    go_around(world, "r0", "r1", "swarm/r0/app/x/set/c")
    world.run(1.0)
    assert world.bots["r1"].inbox == []
    assert counted(world, "refused") == 1


@pytest.mark.parametrize(
    ("packet", "counter"),
    [
        (Packet("r0", "r1", KEY, b"", 1), "around_no_way"),
        (Packet("r3", "r1", KEY, b"", 9), "around_no_way"),  # its own packet comes back to r3
        (Packet("r0", "r9", KEY, b"", 9), "bad_packets"),
        (Packet("r9", "r1", KEY, b"", 9), "bad_packets"),
    ],
)
def test_what_cannot_go_on_is_dropped(packet: Packet, counter: str) -> None:
    world = settled(ring(4))
    world.step(
        "r3",
        lambda overlays: overlays.receive(
            "r0", UNICAST, "swarm/r0/mesh/unicast", around.encode(packet), SYNC, world.now
        ),
    )
    world.run(1.0)
    assert world.messages[UNICAST] == 0
    assert world.bots["r3"].counters[counter] == 1


@given(st.builds(Packet, names, names, st.just(KEY), st.binary(max_size=99), st.integers(0, 255)))
def test_round_trip(packet: Packet) -> None:
    assert around.decode(around.encode(packet)) == packet


def test_a_packet_of_another_kind_and_a_wrong_key_are_refused() -> None:
    data = around.encode(Packet("r0", "r1", KEY, b"", 9))
    with pytest.raises(FrameError, match="AROUND is 8"):
        around.decode(bytes([AROUND + 1]) + data[1:])
    with pytest.raises(FrameError, match="overlay packet: key "):
        around.decode(data.replace(b"swarm/", b"warms/"))
    with pytest.raises(FrameError, match="1 bytes"):
        around.decode(data[:1])
