"""Large messages of flood and unicast: every byte once, whatever happens to links, robots and packets."""

from collections.abc import Sequence
from functools import cache

import pytest
from conftest import costly
from hypothesis import given, settings
from hypothesis import strategies as st
from overlay_world import World, full, line, ring, thesis_d

from services.mesh.core.actions import Transmit
from services.mesh.core.bulk import exchange, pieces, transfers
from services.mesh.core.bulk.pieces import GONE, OFFER, PIECE, SIZE, WANT, Fetch, MessageId, Packet
from services.mesh.core.overlays import large_messages
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import BULK, MAX_MESSAGE, UNICAST
from swarm.errors import FrameError
from swarm.messages import FloodRequest, SendRequest

GRAPHS = {"line": line(4), "ring": ring(5), "full": full(4), "thesis-d": thesis_d()}


@cache
def numbers(count: int) -> bytes:
    return b"".join(b"%06d" % n for n in range(count))


def large(count: int, size: int = 60_000) -> bytes:
    """A payload that shows it if a piece is at the wrong place."""
    return b"%06d" % count + numbers(size // 6 - 1)


def arrived(world: World, name: str, topic: str) -> list[bytes]:
    return [payload for key, payload in world.bots[name].inbox if topic in key]


def idle(world: World) -> bool:
    """Nothing is on its way, and nobody remembers anything of it but what is held for latecomers."""
    for bot in world.bots.values():
        each = bot.overlays._large
        busy = (
            each._exchange._fetches or each._exchange._sources or each._exchange._waiting or each._floods._coming
        ) or (each._transfers._keys or each._transfers._own.messages or each._transfers._own.size)
        if busy:
            return False
    return True


# -- unicast ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [packets.MAX_MESSAGE + 1, 3 * SIZE, 100_000, MAX_MESSAGE])
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
    world.run(0.15)
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


# -- flood -----------------------------------------------------------------------------------------------------


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


# -- attacks by a member ---------------------------------------------------------------------------------------


def inject(world: World, name: str, sender: str, packet: Packet) -> None:
    """A packet as a member may make it."""
    data = pieces.encode(packet)
    channel = f"swarm/{sender}/mesh/unicast"
    world.step(name, lambda each: each.receive(sender, UNICAST, channel, data, BULK, world.now))


def test_announced_sizes_reserve_no_more_than_the_limits_and_not_for_long() -> None:
    world = World(line(3))
    world.settle()
    key = "swarm/r0/app/test/send/r1"
    for number in range(1, 200):
        id = MessageId("r0", 7, number, flood=False)
        inject(world, "r1", "r0", Packet(OFFER, "r0", "r1", id, pieces.encode_offer(MAX_MESSAGE, key), 9))
    coming = world.bots["r1"].overlays._large._exchange.fetching
    assert sum(fetch.total for fetch in coming) <= transfers.MAX_COMING_EACH
    # Others' messages still come: what has stalled makes room.
    ticket = world.send("r2", "r1", large(1, MAX_MESSAGE), priority="bulk")
    world.run(20.0)
    assert world.got("r1", "/send/r1") == [large(1, MAX_MESSAGE)]
    assert world.sent("r2", ticket) is not None
    world.run(exchange.PATIENCE)
    assert idle(world)
    with pytest.raises(FrameError, match="are allowed"):
        pieces.decode_offer(pieces.encode_offer(2**32 - 1, key))


def test_pieces_nobody_asked_for_are_dropped() -> None:
    world = World(line(3))
    world.settle()
    world.send("r0", "r1", large(1, 500_000), priority="bulk")
    world.run(0.15)
    (fetch,) = world.bots["r1"].overlays._large._exchange.fetching
    before = dict(fetch._parts)
    for index, data in ((fetch.count - 1, b"x" * (fetch.total % SIZE)), (0, b"y" * SIZE)):
        inject(world, "r1", "r0", Packet(PIECE, "r0", "r1", fetch.id, pieces.encode_piece(index, data), 9))
    for index, data in ((1, b"short"), (fetch.count, b"x" * SIZE), (65535, b"x")):
        inject(world, "r1", "r0", Packet(PIECE, "r0", "r1", fetch.id, pieces.encode_piece(index, data), 9))
    assert fetch._parts == before
    assert world.bots["r1"].counters["bad_packets"] == 3
    world.run(10.0)
    assert world.got("r1", "/send/r1") == [large(1, 500_000)]


def test_whoever_asks_for_what_there_is_not_is_told_so() -> None:
    world = World(line(2))
    world.settle()
    heard: list[Transmit] = []
    world.watch = lambda sender, peer, packet: heard.append(packet)
    for flood in (False, True):
        id = MessageId("r1", 7, 1, flood)
        inject(world, "r1", "r0", Packet(WANT, "r0", "r1", id, pieces.encode_want(0, range(100)), 9))
    answers = [pieces.decode(packet.payload) for packet in heard]
    assert [(answer.kind, answer.id.flood) for answer in answers] == [(GONE, False), (GONE, True)]


@settings(max_examples=60, deadline=None)
@given(st.integers(OFFER, GONE), st.booleans(), st.integers(1, 3), st.binary(max_size=60))
def test_any_body_of_a_member_is_taken_or_counted(kind: int, flood: bool, number: int, body: bytes) -> None:
    world = World(line(3))
    world.settle()
    incarnation = world.bots["r0"].overlays._flood.incarnation
    world.send("r0", "r1", large(1, 20_000), priority="bulk")
    world.flood("r0", large(2, 20_000), priority="bulk")
    world.run(0.1)
    inject(world, "r1", "r0", Packet(kind, "r0", "r1", MessageId("r0", incarnation, number, flood), body, 9))
    world.run(exchange.PATIENCE + 20.0)
    assert world.got("r1", "/flood") == [large(2, 20_000)]
    assert len(world.got("r1", "/send/r1")) <= 1
    assert idle(world)


@given(st.integers(1, 9), st.lists(st.tuples(st.integers(0, 11), st.integers(0, 3)), max_size=60))
def test_a_fetch_ends_with_every_piece_once(count: int, steps: list[tuple[int, int]]) -> None:
    fetch = Fetch(MessageId("r0", 1, 1, flood=False), count * SIZE - 7, 0.0)
    for index, what in steps:
        if what == 0:
            fetch.pick(0.0)
        elif what == 1:
            fetch.ask_again()
        elif index < count:
            size = SIZE - 7 * (index == count - 1)
            fetch.take(index, bytes([index]) * size, 1.0)
        else:
            with pytest.raises(FrameError):
                fetch.take(index, bytes(SIZE), 1.0)
        assert fetch.asked + fetch.have <= count
    for _ in range(2):
        while (index := fetch.pick(0.0)) is not None:
            if index % 2 or _:
                fetch.take(index, bytes([index]) * (SIZE - 7 * (index == count - 1)), 1.0)
        fetch.ask_again()
    assert fetch.complete
    assert fetch.payload() == b"".join(bytes([n]) * SIZE for n in range(count))[: count * SIZE - 7]


# -- any sequence of accidents ---------------------------------------------------------------------------------

accidents = st.lists(
    st.one_of(
        st.tuples(st.just("send"), st.integers(0, 5), st.integers(0, 5)),
        st.tuples(st.just("flood"), st.integers(0, 5), st.just(0)),
        st.tuples(st.just("latest"), st.integers(0, 5), st.integers(0, 1)),
        st.tuples(st.just("cut"), st.integers(0, 20), st.integers(0, 1)),
        st.tuples(st.just("join"), st.integers(0, 20), st.just(0)),
        st.tuples(st.just("restart"), st.integers(0, 5), st.just(0)),
        st.tuples(st.just("wait"), st.floats(0.001, 1.5), st.just(0)),
    ),
    max_size=30,
)


@costly(20)
@given(
    accidents, st.sampled_from(sorted(GRAPHS)), st.floats(0.0, 0.02), st.sampled_from((0.0, 0.05)), st.integers(0, 99)
)
def test_whatever_happens_large_messages_arrive_whole_once_and_are_told_truly(
    steps: Sequence[tuple[str, float, int]], graph: str, jitter: float, loss: float, seed: int
) -> None:
    world = World(GRAPHS[graph], jitter=jitter, seed=seed)
    world.run(1.0)
    world.loss = loss
    edges = [sorted(edge) for edge in world.edges]
    lives: dict[str, int] = dict.fromkeys(world.names, 0)
    inboxes: list[tuple[str, list[tuple[str, bytes]]]] = []
    sent: dict[int, tuple[str, str, int]] = {}
    floods: dict[int, tuple[str, int]] = {}
    for count, (what, value, option) in enumerate(steps):
        name = world.names[int(value) % len(world.names)]
        match what:
            case "send":
                to = world.names[option % len(world.names)]
                sent[count] = (name, to, lives[name])
                request = SendRequest(f"t{count}", "test", to, large(count), "bulk", 100.0)
                world.step(name, lambda each, request=request: each.request(request, world.now))
            case "flood":
                floods[count] = (name, lives[name])
                wish = FloodRequest(f"t{count}", "test", large(count), "bulk", False)
                world.step(name, lambda each, wish=wish: each.request(wish, world.now))
            case "latest":
                key, payload = f"swarm/{name}/rule/k{option}", large(count)
                world.step(
                    name,
                    lambda each, key=key, payload=payload: each.flood(key, payload, BULK, world.now, latest=True),
                )
            case "cut":
                world.cut(*edges[int(value) % len(edges)], silent=bool(option))
            case "join":
                world.join(*edges[int(value) % len(edges)])
            case "restart":
                inboxes.append((name, world.bots[name].inbox))
                world.kill(name)
                world.start(name)
                lives[name] += 1
            case "wait":
                world.run(value)
    world.run(60.0)
    inboxes += [(name, bot.inbox) for name, bot in world.bots.items()]
    whole = {large(count) for count in range(len(steps))}
    for _, inbox in inboxes:
        ours = [(key, data) for key, data in inbox if len(data) > packets.MAX_MESSAGE]
        assert all(data in whole for _, data in ours), "bytes at the wrong place"
        once = [(key, data[:6]) for key, data in ours if "/rule/" not in key]
        assert len(once) == len(set(once)), "twice in one life"
        for key in {key for key, _ in ours if "/rule/" in key}:
            values = [data for each, data in ours if each == key]
            assert values == sorted(values), "an older value after a newer one"
    for count, (name, to, life) in sent.items():
        if life == lives[name]:
            answer = world.sent(name, f"t{count}")
            assert answer is not None, "no answer at all"
            got = any(data == large(count) for who, inbox in inboxes if who == to for _, data in inbox)
            assert got or not answer.delivered, "it says that it arrived"
    for count, (name, life) in floods.items():
        if life == lives[name]:
            flooded = world.flooded(name, f"t{count}")
            assert flooded is not None, "no answer at all"
            for who in flooded.robots:
                assert any(data == large(count) for each, inbox in inboxes if each == who for _, data in inbox)
    # In the end everything is quiet, and what is asked for then works.
    world.loss = 0.0
    for edge in world.edges:
        world.join(*sorted(edge))
    world.run(40.0)
    assert idle(world)
    world.clear()
    for name in world.names:
        ticket = world.flood(name, large(999), priority="bulk", ticket=f"end-{name}")
        for to in world.names:
            world.send(name, to, large(998), priority="bulk", ticket=f"end-{name}-{to}")
        world.run(5.0)
        answer = world.flooded(name, ticket)
        assert answer is not None
        assert answer.complete
        assert set(answer.robots) == set(world.names) - {name}
    for name in world.names:
        assert len(world.got(name, f"/send/{name}")) == len(world.names)
