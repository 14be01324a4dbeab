"""Unicast that avoids the link between sender and receiver: over other robots, along the shortest way, once."""

import networkx
import pytest
from overlay_world import World, full, line, ring, thesis_d

from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import SYNC, UNICAST
from services.mesh.core.wire.packets import UnicastMessage

KEY = "swarm/r0/app/x/sync/c/r1/around"
DIAMOND = [("r0", "r1"), ("r0", "r2"), ("r0", "r3"), ("r1", "r2"), ("r1", "r3")]


def settled(edges: list[tuple[str, str]]) -> World:
    world = World(edges)
    world.settle()
    return world


def send(world: World, sender: str, to: str, key: str = KEY, payload: bytes = b"hello") -> None:
    world.step(sender, lambda overlays: overlays.send(to, key, payload, SYNC, world.now, latest=False, avoid_link=True))


def counted(world: World, what: str) -> int:
    return sum(bot.counters[f"unicast_{what}"] for bot in world.bots.values())


@pytest.mark.parametrize("edges", [ring(6), full(6), thesis_d()], ids=("loop", "full", "thesis-d"))
def test_a_message_takes_the_shortest_way_without_the_link_and_nobody_answers(edges: list[tuple[str, str]]) -> None:
    world = settled(edges)
    for sender, to in sorted(edges):
        world.clear()
        graph = networkx.Graph(edges)
        graph.remove_edge(sender, to)
        hops = networkx.shortest_path_length(graph, sender, to) if networkx.has_path(graph, sender, to) else 0
        began = world.now
        send(world, sender, to, KEY.replace("r0", sender))
        world.run(1.0)
        assert world.messages[UNICAST] == hops
        assert world.bots[to].times == ([pytest.approx(began + hops * 0.03)] if hops else [])


def test_a_message_arrives_while_the_link_swallows_everything() -> None:
    world = settled(ring(6))
    world.cut("r0", "r1", silent=True)
    send(world, "r0", "r1")
    world.run(0.2)
    assert world.bots["r1"].inbox == [(KEY, b"hello")]


def test_a_message_arrives_when_the_link_has_been_given_up() -> None:
    world = settled(ring(6))
    world.cut("r0", "r1")
    world.settle()
    send(world, "r0", "r1")
    world.run(0.2)
    assert world.bots["r1"].inbox == [(KEY, b"hello")]


def test_a_message_without_a_way_is_dropped_and_counted() -> None:
    world = settled(line(3))
    send(world, "r0", "r1")
    world.run(1.0)
    assert (world.messages[UNICAST], counted(world, "no_route"), counted(world, "avoiding")) == (0, 1, 0)


def test_a_message_that_a_dead_link_swallows_is_not_sent_again() -> None:
    world = settled(DIAMOND)
    world.cut("r1", "r2", silent=True)
    world.clear()
    send(world, "r0", "r1")
    world.run(10.0)
    assert world.bots["r1"].inbox == []
    assert (counted(world, "retries"), counted(world, "rerouted")) == (0, 0)


def test_a_new_link_is_a_new_way() -> None:
    world = World([*line(3), ("r0", "r2")], start=True)
    world.settle()
    world.cut("r0", "r2")
    world.settle()
    send(world, "r0", "r1")
    world.join("r0", "r2")
    world.run(2.0)
    assert counted(world, "no_route") == 1
    send(world, "r0", "r1")
    world.run(0.2)
    assert world.bots["r1"].inbox == [(KEY, b"hello")]
    assert counted(world, "forwarded") == 1


def test_a_message_that_no_rule_lets_in_is_refused_without_an_answer() -> None:
    world = settled(ring(4))
    world.clear()
    send(world, "r0", "r1", "swarm/r0/app/x/set/c")
    world.run(1.0)
    assert world.bots["r1"].inbox == []
    assert counted(world, "refused") == 1
    assert world.messages[UNICAST] == 3


@pytest.mark.parametrize(
    ("message", "counter"),
    [
        (UnicastMessage("r0", "r1", 1, 0, KEY, b"", 1), "unicast_expired"),
        (UnicastMessage("r0", "r9", 1, 0, KEY, b"", 9), "bad_packets"),
        (UnicastMessage("r9", "r1", 1, 0, KEY, b"", 9), "bad_packets"),
    ],
)
def test_a_message_that_cannot_go_on_is_dropped(message: UnicastMessage, counter: str) -> None:
    world = settled(ring(4))
    world.clear()
    data = packets.encode_message(message)
    world.step("r3", lambda overlays: overlays.receive("r0", UNICAST, "swarm/r0/mesh/unicast", data, SYNC, world.now))
    world.run(1.0)
    assert world.messages[UNICAST] == 0
    assert world.bots["r3"].counters[counter] == 1


def test_a_robot_whose_link_has_ended_sends_a_message_back_to_take_another_way() -> None:
    world = settled(DIAMOND)
    world.cut("r1", "r2")
    send(world, "r0", "r1")  # r0 has not heard of the cut, and sends to r2
    world.run(1.0)
    assert world.bots["r1"].inbox == [(KEY, b"hello")]
    assert world.messages[UNICAST] == 4
