"""Echoes between meshes, and what links tell of themselves."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mesh_world import World

from services.mesh.core.link import neighbour
from services.mesh.core.link.neighbour import MAX_AWAITED, Prober
from services.mesh.core.wire.frames import SYNC
from swarm.config.types import RelayRule
from swarm.errors import FrameError
from swarm.messages import Echo, EchoRequest
from swarm.messages.codec import decode


def echoes(world: World, robot: str) -> list[Echo]:
    key = f"swarm/{robot}/mesh/echo"
    return [decode(Echo, payload, key) for each, payload in world.bots[robot].inbox if each == key]


def ping(world: World, robot: str, request: EchoRequest) -> list[Echo]:
    world.bots[robot].inbox.clear()
    world.step(robot, lambda node: node.connections.ping(request, world.now))
    world.run(1.0)
    return echoes(world, robot)


@pytest.mark.parametrize("priority", ["sync", "bulk"])
@pytest.mark.parametrize("size", [11, 1000, 4085])
def test_a_ping_comes_back_after_a_round_trip_and_reaches_no_bus(priority: str, size: int) -> None:
    world = World([("r0", "r1")], latency=0.03)
    world.run(1.0)
    (echo,) = ping(world, "r0", EchoRequest("r1", 7, size, priority=priority))
    assert echo.rtt == pytest.approx(0.06, abs=0.001)
    assert (echo.peer, echo.sequence, echo.index, echo.size) == ("r1", 7, 0, size)
    assert not world.bots["r1"].inbox


def test_many_pings_are_numbered_and_short_answers_are_short() -> None:
    world = World([("r0", "r1")])
    world.run(1.0)
    before = world.link("r1", "r0").sent_bytes
    found = ping(world, "r0", EchoRequest("r1", 1, 1000, count=20, priority="bulk", short=True))
    assert [echo.index for echo in found] == list(range(20))
    assert world.link("r1", "r0").sent_bytes - before < 3000


def test_requests_without_end_leave_a_bounded_number_of_awaited_answers() -> None:
    world = World([("r0", "r1")])
    world.run(1.0)
    node = world.bots["r0"].node
    for number in range(100):
        world.step(
            "r0", lambda node, number=number: node.connections.ping(EchoRequest("r1", number, 11, 256), world.now)
        )
    assert len(node.connections.prober._sent) <= MAX_AWAITED


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        (EchoRequest("r9", 1, 50), "r9 is not a neighbour"),
        (EchoRequest("r1", 1, 10), "size 10: 11 to 4085"),
        (EchoRequest("r1", 1, 5000), "size 5000: 11 to 4085 bytes are allowed in class sync"),
        (EchoRequest("r1", 1, 50, count=0), "count 0"),
        (EchoRequest("r1", 1, 65536, count=256, priority="bulk"), "together at most"),
        (EchoRequest("r1", 1, 50, priority="control"), "class 'control': expected sync or bulk"),
        (EchoRequest("r1", -1, 50), "sequence -1"),
    ],
)
def test_what_cannot_be_pinged_is_said(request_: EchoRequest, reason: str) -> None:
    world = World([("r0", "r1")])
    world.run(1.0)
    (echo,) = ping(world, "r0", request_)
    assert echo.rtt is None
    assert reason in echo.reason


def test_a_link_that_is_down_is_said() -> None:
    world = World([("r0", "r1")])
    world.run(1.0)
    world.kill("r1")
    world.run(1.0)
    (echo,) = ping(world, "r0", EchoRequest("r1", 1, 50))
    assert echo.reason == "the link to r1 is down"


@given(st.binary(max_size=40))
def test_any_echo_is_answered_or_refused(payload: bytes) -> None:
    prober = Prober("r0", ("r1",))
    with suppress(FrameError):
        assert prober.receive(neighbour.ping_key("r1"), payload, 0.0) in (payload, payload[: neighbour.MIN_SIZE])
    with suppress(FrameError):
        assert prober.receive(neighbour.pong_key("r1"), payload, 0.0) is None


def test_bad_echoes_are_counted_and_harm_nothing() -> None:
    world = World([("r0", "r1")])
    world.run(1.0)
    (session,) = world.bots["r0"].ends
    session.queue.push(SYNC, "swarm/r0/mesh/ping", b"short", latest=False)
    session.queue.push(SYNC, "swarm/r0/mesh/pong", b"", latest=False)
    session.queue.push(SYNC, "swarm/r1/mesh/ping", bytes(11), latest=False)
    world.run(1.0)
    assert world.bots["r1"].counters["inbound_refused"] == 3
    assert world.all_up()


def test_answers_that_never_come_are_forgotten() -> None:
    world = World([("r0", "r1")])
    world.run(1.0)
    node = world.bots["r0"].node
    prober, link = node.connections.prober, node.connections.links["r1"]
    for number in range(100):
        assert prober.ping(EchoRequest("r1", number, 50, count=10), link, number * 1.0) is None
    assert len(prober._sent) <= 10 * (neighbour.FORGET + 1)


# -- what a link tells --


def test_a_link_tells_its_round_trips_rates_and_losses() -> None:
    world = World([("r0", "r1")], latency=0.03, rules=[RelayRule("swarm/{self}/x/*", queue="all")])
    world.publish("r0", "swarm/r0/x/a", b"before there is a link")
    world.run(10.0)
    link = world.link("r0", "r1")
    assert link.dropped == 1
    assert link.rtt_min == pytest.approx(0.06, abs=0.001)
    assert link.rtt_min <= link.rtt_median <= link.rtt_p99
    assert 50 < link.sent_rate < 500
    for number in range(80):
        world.publish("r0", f"swarm/r0/x/{number}", bytes(20_000))
    link = world.link("r0", "r1")
    assert link.queue > 1_000_000
    assert link.in_flight <= link.window + 2000
    assert link.dropped > 1
    world.run(0.5)
    assert world.link("r1", "r0").received_bytes > 10_000
    world.kill("r1")
    world.run(1.0)
    down = world.link("r0", "r1")
    assert (down.queue, down.in_flight, down.rtt_median, down.sent_rate) == (0, 0, None, 0.0)
    assert down.sent_bytes >= link.sent_bytes
