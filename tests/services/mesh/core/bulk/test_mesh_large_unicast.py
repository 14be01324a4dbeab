"""Large messages of unicast: every byte once, whatever happens to links, robots and packets."""

import mesh_world
import pytest
from large_world import arrived, idle, large
from overlay_world import World, full, line, ring

from services.mesh.core.bulk import exchange, pieces, transfers
from services.mesh.core.bulk.pieces import SIZE
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import BULK, MAX_MESSAGE


@pytest.mark.parametrize("size", [packets.UNICAST_ROOM + 1, 3 * SIZE, 100_000, MAX_MESSAGE])
def test_a_large_message_arrives_whole_and_once(size: int) -> None:
    world = World(line(4))
    world.settle()
    payload = bytes(range(256)) * (size // 256) + bytes(size % 256)
    ticket = world.send("r0", "r3", payload, priority="bulk")
    world.run(30.0)
    assert world.got("r3", "/send/r3") == [payload]
    sent = world.sent("r0", ticket)
    assert sent is not None
    assert sent.delivered
    assert idle(world)
    total = {name: sum(bot.counters[name] for bot in world.bots.values()) for name in exchange.COUNTERS}
    assert total == {
        "pieces_sent": pieces.count_of(size), "pieces_repeated": 0, "pieces_useless": 0, "large_incomplete": 0
    }  # fmt: skip


def test_a_small_message_does_not_wait_for_a_large_one() -> None:
    world = World(line(4))
    world.settle()
    world.send("r0", "r3", large(1, MAX_MESSAGE), priority="bulk")
    world.run(0.5)
    world.send("r0", "r3", b"small", priority="bulk")
    world.run(0.1)
    assert world.got("r3", "/send/r3") == [b"small"]


def test_many_at_once_from_many_to_one() -> None:
    world = World(full(6))
    world.settle()
    for name in world.names[1:]:
        for count in range(6):
            world.send(name, "r0", large(count), priority="bulk")
    world.run(20.0)
    got = world.got("r0", "/send/r0")
    assert len(got) == 30
    assert sorted(set(got)) == [large(count) for count in range(6)]
    assert idle(world)


def test_a_receiver_without_room_takes_them_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transfers, "MAX_COMING_BYTES", 130_000)
    monkeypatch.setattr(transfers, "MAX_COMING_EACH", 100_000)
    world = World(full(6))
    world.settle()
    for name in world.names[1:]:
        for count in range(3):
            world.send(name, "r0", large(count), priority="bulk")
    world.run(0.08)
    coming = world.bots["r0"].overlays._large._exchange.fetching
    assert 0 < sum(fetch.total for fetch in coming) <= 130_000
    world.run(60.0)
    assert len(world.got("r0", "/send/r0")) == 15
    assert world.bots["r0"].counters["unicast_large_later"] > 0
    assert idle(world)


def test_too_much_is_refused_at_once_and_said() -> None:
    world = World(line(2))
    world.settle()
    world.edges[frozenset(("r0", "r1"))].alive = False
    tickets = [world.send("r0", "r1", bytes(MAX_MESSAGE), priority="bulk") for _ in range(5)]
    assert [world.sent("r0", ticket) is None for ticket in tickets] == [True] * 4 + [False]
    cases = {
        tickets[4]: "4 large messages of 4194304 bytes are under way already",
        world.send("r0", "r1", bytes(MAX_MESSAGE + 1), priority="bulk"): "at most 1048576 in its class",
        world.send("r0", "r1", bytes(5000)): "in its class",
    }
    for ticket, text in cases.items():
        sent = world.sent("r0", ticket)
        assert sent is not None
        assert text in sent.problem


@pytest.mark.parametrize("silent", [False, True])
def test_a_link_that_dies_in_mid_transfer_is_gone_around(silent: bool) -> None:
    world = World(ring(6))
    world.settle()
    payload = large(1, MAX_MESSAGE)
    ticket = world.send("r0", "r2", payload, priority="bulk")
    world.run(1.0)
    assert not world.got("r2", "/send/r2")
    world.cut("r1", "r2", silent=silent)
    world.run(20.0)
    assert world.got("r2", "/send/r2") == [payload]
    sent = world.sent("r0", ticket)
    assert sent is not None
    assert sent.delivered
    repeated = sum(bot.counters["pieces_repeated"] for bot in world.bots.values())
    assert repeated <= 3 * 128 * 1024 // SIZE, "a window or two, not all of it"


def test_a_restarted_receiver_gets_it_anew_and_a_restarted_sender_leaves_nothing_behind() -> None:
    world = World(line(3))
    world.settle()
    ticket = world.send("r0", "r2", large(1, MAX_MESSAGE), priority="bulk")
    world.run(1.0)
    world.kill("r2")
    world.start("r2")
    world.run(20.0)
    assert world.got("r2", "/send/r2") == [large(1, MAX_MESSAGE)]
    assert world.sent("r0", ticket) is not None
    world.send("r0", "r2", large(2, MAX_MESSAGE), priority="bulk")
    world.run(1.0)
    world.kill("r0")
    world.run(exchange.PATIENCE + 1.0)
    assert world.got("r2", "/send/r2") == [large(1, MAX_MESSAGE)]
    assert world.bots["r2"].counters["large_incomplete"] == 1
    assert idle(world)


def test_a_receiver_that_is_gone_is_given_up_with_a_reason() -> None:
    world = World(line(3))
    world.settle()
    ticket = world.send("r0", "r2", large(1, MAX_MESSAGE), priority="bulk")
    late = world.send("r0", "r2", large(2, MAX_MESSAGE), priority="bulk", timeout=1.0)
    world.run(0.5)
    world.kill("r2")
    world.run(transfers.SILENCE + 1.0)
    texts = {ticket: "no answer from r2", late: "in time"}
    for each, text in texts.items():
        sent = world.sent("r0", each)
        assert sent is not None
        assert text in sent.problem
    assert idle(world)


def test_what_may_not_come_in_is_refused_before_a_piece_was_sent() -> None:
    world = World(line(3))
    world.settle()
    ends: list[str] = []
    parcels = world.bots["r0"].overlays._unicast.transfers
    parcels._own._ended = lambda token, to, problem: ends.append(problem)
    for key in ("swarm/r2/balancer/set/mode", "swarm/r2/balancer/set/allowed"):
        world.step("r0", lambda each, key=key: each.send("r2", key, large(1), BULK, world.now, latest=False))
    world.run(3.0)
    assert sorted(ends) == ["", "r2 lets no swarm/r2/balancer/set/mode in"]
    assert [key for key, _ in world.bots["r2"].inbox] == ["swarm/r2/balancer/set/allowed"]
    assert world.bots["r0"].counters["pieces_sent"] == pieces.count_of(60_000)


def test_a_newer_value_takes_the_place_of_a_large_one_under_way() -> None:
    world = World(line(3))
    world.settle()
    key = "swarm/r2/balancer/set/allowed"
    for count in range(5):
        payload = large(count, MAX_MESSAGE)
        world.step("r0", lambda each, payload=payload: each.send("r2", key, payload, BULK, world.now, latest=True))
        world.run(0.3)
    world.run(20.0)
    assert arrived(world, "r2", "allowed") == [large(4, MAX_MESSAGE)]
    assert idle(world)


@pytest.mark.parametrize("after", [0.1, 0.4, 0.7, 1.0])
def test_a_newer_value_arrives_though_nothing_else_happens_in_the_swarm(after: float) -> None:
    """Long after the start no change of ways makes anybody ask again."""
    world = mesh_world.World([("r0", "r1")], bandwidth=78_000.0)
    world.run(20.0)
    key = "swarm/r0/app/x/send/r1"

    def send(payload: bytes) -> None:
        world.step(
            "r0", lambda node: node.ask(lambda o, now: o.send("r1", key, payload, BULK, now, latest=True), world.now)
        )

    send(large(0, 150_000))
    world.run(after)
    send(large(1, 150_000))
    world.run(10.0)
    assert (key, large(1, 150_000)) in world.bots["r1"].inbox
