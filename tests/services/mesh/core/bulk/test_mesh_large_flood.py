"""Large messages of flood: all robots get them by a tree, and ask another one where their source is lost."""

import pytest
from large_world import GRAPHS, arrived, idle, large
from overlay_world import World, full, line, ring

from services.mesh.core.actions import Transmit
from services.mesh.core.bulk import pieces
from services.mesh.core.overlays import large_messages
from services.mesh.core.wire.frames import BULK, MAX_MESSAGE


@pytest.mark.parametrize("graph", sorted(GRAPHS))
def test_a_large_flood_reaches_all_by_a_tree(graph: str) -> None:
    world = World(GRAPHS[graph])
    world.settle()
    ticket = world.flood("r0", large(1, MAX_MESSAGE), priority="bulk")
    world.run(30.0)
    for name in world.names[1:]:
        assert world.got(name, "/flood") == [large(1, MAX_MESSAGE)]
    answer = world.flooded("r0", ticket)
    assert answer is not None
    assert answer.complete
    assert set(answer.robots) == set(world.names) - {"r0"}
    sent = sum(bot.counters["pieces_sent"] for bot in world.bots.values())
    assert sent == (len(world.names) - 1) * pieces.count_of(MAX_MESSAGE)
    assert world.bots["r0"].counters["wave_sent"] + sum(
        world.bots[name].counters["wave_sent"] for name in world.names[1:]
    ) == 2 * len(world.edges)
    assert idle(world)
    world.run(large_messages.HOLD + 1.0)
    assert not any(bot.overlays._large._floods._held for bot in world.bots.values())


def test_a_large_flood_has_not_reached_a_robot_that_only_heard_its_announcement() -> None:
    world = World(line(3))
    world.settle()
    world.watch = None
    ticket = world.flood("r0", large(1, MAX_MESSAGE), priority="bulk")
    world.run(0.5)
    world.kill("r2")
    world.run(30.0)
    answer = world.flooded("r0", ticket)
    assert answer is not None
    assert answer.robots == ("r1",)


def test_who_loses_its_source_asks_another_one() -> None:
    world = World(ring(4))
    world.settle()
    ticket = world.flood("r0", large(1, MAX_MESSAGE), priority="bulk")
    world.run(0.5)
    fetch = next(iter(world.bots["r2"].overlays._large._exchange.fetching))
    assert fetch.source is not None
    world.kill(fetch.source)
    world.run(30.0)
    assert world.got("r2", "/flood") == [large(1, MAX_MESSAGE)]
    answer = world.flooded("r0", ticket)
    assert answer is not None
    assert "r2" in answer.robots


def test_large_latest_values_are_repaired_and_only_the_newest_one_counts() -> None:
    world = World(line(3))
    world.settle()
    world.cut("r1", "r2")
    world.run(1.0)
    for count in range(3):
        payload = large(count, 300_000)
        world.step(
            "r0", lambda each, payload=payload: each.flood("swarm/r0/rule/k", payload, BULK, world.now, latest=True)
        )
        world.run(0.2)
    world.run(10.0)
    assert arrived(world, "r1", "/rule/k")[-1] == large(2, 300_000)
    world.join("r1", "r2")
    world.run(10.0)
    assert arrived(world, "r2", "/rule/k") == [large(2, 300_000)]
    world.kill("r0")
    world.kill("r2")
    world.run(1.0)
    world.start("r2")
    world.run(10.0)
    assert arrived(world, "r2", "/rule/k") == [large(2, 300_000)]
    assert idle(world)


def test_announcements_without_room_go_round_no_circles(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World(full(4))
    world.settle()
    for older in (300_000, 301_000):
        payload = large(older, older)
        world.step(
            "r0", lambda each, payload=payload: each.flood("swarm/r0/rule/k", payload, BULK, world.now, latest=True)
        )
    monkeypatch.setattr(large_messages, "MAX_BYTES", 100_000)
    world.run(30.0)
    assert sum(bot.counters["flood_sent"] for bot in world.bots.values()) < 100
    monkeypatch.undo()
    world.run(60.0)
    for name in world.names[1:]:
        assert arrived(world, name, "/rule/k") == [large(301_000, 301_000)]


def test_too_many_bytes_of_floods_are_refused() -> None:
    world = World(line(2))
    world.settle()
    world.edges[frozenset(("r0", "r1"))].alive = False
    tickets = [world.flood("r0", bytes(MAX_MESSAGE), priority="bulk") for _ in range(5)]
    tickets.append(world.flood("r0", bytes(MAX_MESSAGE + 1), priority="bulk"))
    answers = [world.flooded("r0", ticket) for ticket in tickets]
    assert answers[:4] == [None] * 4
    assert ["under way" in answer.problem or "at most" in answer.problem for answer in answers[4:] if answer] == [
        True, True
    ]  # fmt: skip


def test_a_large_flood_that_many_later_ones_overtake_is_delivered_and_told_truly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Floods of all sizes are counted together, so that the number of a large one may be far behind the newest."""
    world = World(line(2))
    world.settle()
    ticket = world.flood("r0", large(1, 100_000), priority="bulk")
    world.run(0.1)
    (slow,) = world.bots["r1"].overlays._large._exchange.fetching
    transmit, held = world._transmit, True

    def hold(name: str, packet: Transmit) -> None:
        piece = packet.key.endswith("/pieces") and pieces.decode(packet.payload)
        if not (held and piece and piece.kind == pieces.PIECE and piece.id == slow.id):
            transmit(name, packet)

    monkeypatch.setattr(world, "_transmit", hold)
    for _ in range(2 * large_messages.MAX_DELIVERED):
        world.flood("r0", b"small")
        world.run(0.01)
    world.flood("r0", large(2, 60_000), priority="bulk")
    world.run(3.0)
    assert large(2, 60_000) in world.got("r1", "/flood")
    held = False
    world.run(20.0)
    assert world.got("r1", "/flood").count(large(1, 100_000)) == 1
    answer = world.flooded("r0", ticket)
    assert answer is not None
    assert (answer.robots, answer.complete) == (("r1",), True)
