"""Floods under virtual time: once to everybody, 2E messages with their echo, also where links break meanwhile."""

import pytest
from overlay_world import GRAPHS, World, line, ring, thesis_d

from services.mesh.core.overlays import echo, flood
from services.mesh.core.overlays.requests import MAX_TICKETS
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import BULK, FLOOD
from swarm.messages import FloodRequest


def wave_messages(world: World) -> None:
    """Count messages of confirmed floods under 1, others under 0."""

    def kind(packet) -> int:  # type: ignore[no-untyped-def]
        if packet.overlay != FLOOD or packet.payload[0] not in (packets.SPREAD, packets.ECHO):
            return 0
        return int(packet.payload[0] == packets.ECHO or packets.decode_spread(packet.payload).echo)

    world.counting = kind


@pytest.mark.parametrize(
    ("name", "reach", "confirm"), [("line", 5, 10), ("loop", 3, 6), ("thesis-d", 2, 4), ("full", 1, 3)]
)
def test_a_flood_reaches_all_in_the_time_of_light_and_is_confirmed_by_2e_messages(
    name: str, reach: int, confirm: int
) -> None:
    """In the full graph the copies that cross are the third leg: they are waited for."""
    world = World(GRAPHS[name])
    wave_messages(world)
    world.settle()
    began = world.now
    ticket = world.flood("r0", b"hello")
    world.run(1.0)
    for other in world.names[1:]:
        assert world.got(other, "/flood") == [b"hello"]
    assert max(world.bots[other].times[0] for other in world.names[1:]) - began == pytest.approx(reach * 0.03)
    answer = world.flooded("r0", ticket)
    assert answer is not None
    assert answer.complete
    assert answer.robots == tuple(world.names[1:])
    assert answer.t - began == pytest.approx(confirm * 0.03)
    assert world.messages[1] == 2 * len(GRAPHS[name])


def test_a_flood_without_echo_costs_less() -> None:
    world = World(thesis_d())
    world.settle()
    world.step("r0", lambda each: each.flood("swarm/r0/rule/x", b"v", BULK, world.now, latest=False))
    world.run(0.5)
    assert all(world.got(name, "/rule/x") == [b"v"] for name in world.names[1:])
    edges = len(thesis_d())
    assert sum(world.messages.values()) == 2 * edges - (len(world.names) - 1)


def test_alone_a_flood_is_complete_at_once() -> None:
    world = World(line(2), start=False)
    world.start("r0")
    ticket = world.flood("r0", b"x")
    answer = world.flooded("r0", ticket)
    assert answer is not None
    assert (answer.robots, answer.complete) == ((), True)


def test_a_repeated_request_is_answered_again_but_done_once() -> None:
    world = World(line(3))
    world.settle()
    for _ in range(3):
        world.flood("r0", b"x", ticket="same")
    world.run(1.0)
    assert world.got("r2", "/flood") == [b"x"]
    world.bots["r0"].inbox.clear()
    world.flood("r0", b"x", ticket="same")
    assert world.flooded("r0", "same") is not None
    world.run(1.0)
    assert world.got("r2", "/flood") == [b"x"]


@pytest.mark.parametrize(
    ("request_", "text"),
    [
        (FloodRequest("t", "No App", b"", "sync", False), "no app's name"),
        (FloodRequest("t", "x", b"", "urgent", False), "expected control, sync, bulk"),
        (FloodRequest("t", "x", bytes(5000), "sync", False), "at most"),
    ],
)
def test_wrong_requests_are_answered(request_: FloodRequest, text: str) -> None:
    world = World(line(2))
    world.settle()
    world.step("r0", lambda each: each.request(request_, world.now))
    answer = world.flooded("r0", "t")
    assert answer is not None
    assert text in answer.problem
    assert not answer.complete


def test_too_many_floods_at_once_are_refused_and_nothing_grows_without_end() -> None:
    world = World(line(2))
    world.settle()
    world.cut("r0", "r1", silent=True)
    count = MAX_TICKETS + 100
    for _ in range(count):
        world.flood("r0", b"x")
    assert len(world.got("r0", "/mesh/flooded")) == count - flood.MAX_ATTEMPTS, "the others are refused"
    assert len(world.bots["r0"].overlays._requests._tickets) == MAX_TICKETS
    assert len(world.bots["r0"].overlays._flood._waves) <= echo.MAX_WAVES
    world.run(60.0)
    assert not world.bots["r0"].overlays._flood._attempts
    assert not len(world.bots["r0"].overlays._flood._waves)


def test_an_orphans_echo_finds_another_way() -> None:
    """r3 has its copy from r2 when that link breaks: its echo goes by r4, and the flood is complete at once."""
    world = World(ring(6))
    world.settle()
    ticket = world.flood("r0", b"x")
    world.run(0.095)  # r3 has heard, its echo is on the way over r2 or r4
    for peer in ("r2", "r4"):
        if world.edges[frozenset(("r3", peer))].up:
            world.cut("r3", peer)
            break
    world.run(1.0)
    answer = world.flooded("r0", ticket)
    assert answer is not None
    assert answer.complete
    assert set(answer.robots) == set(world.names) - {"r0"}
    assert world.got("r3", "/flood") == [b"x"]


def test_a_second_try_is_not_delivered_twice() -> None:
    world = World(line(4))
    world.settle()
    ticket = world.flood("r0", b"x")
    world.run(0.05)  # r1 has it, r2 has not
    world.cut("r1", "r2")
    world.join("r1", "r2")
    world.run(10.0)
    answer = world.flooded("r0", ticket)
    assert answer is not None
    assert answer.complete
    assert answer.robots == ("r1", "r2", "r3")
    assert world.bots["r0"].counters["flood_retries"] == 1
    for name in ("r1", "r2", "r3"):
        assert world.got(name, "/flood") == [b"x"]


def test_who_cannot_be_reached_is_not_waited_for() -> None:
    world = World(line(4))
    world.settle()
    world.cut("r1", "r2")
    world.run(1.0)
    ticket = world.flood("r0", b"x")
    world.run(0.2)
    answer = world.flooded("r0", ticket)
    assert answer is not None
    assert (answer.robots, answer.complete) == (("r1",), True)


def test_a_silent_robot_makes_a_flood_incomplete_in_the_end() -> None:
    world = World(line(3))
    world.settle()
    world.edges[frozenset(("r1", "r2"))].alive = False  # and nobody ever notices
    ticket = world.flood("r0", b"x")
    world.run(30.0)
    answer = world.flooded("r0", ticket)
    assert answer is not None
    assert not answer.complete
    assert answer.problem


def test_a_new_link_during_a_flood_gets_its_answer() -> None:
    """r1 joins r3 after r3 has had its copy, and before r1 has: r3 owes r1 an answer it never planned."""
    world = World([("r0", "r1"), ("r0", "r3"), ("r1", "r3")])
    world.settle()
    world.cut("r1", "r3")
    world.run(1.0)
    world.latencies[frozenset(("r0", "r1"))] = 0.5
    ticket = world.flood("r0", b"x")
    world.run(0.1)
    world.join("r1", "r3")
    world.run(3.0)
    answer = world.flooded("r0", ticket)
    assert answer is not None
    assert answer.complete
    assert world.bots["r0"].counters["flood_retries"] == 0
