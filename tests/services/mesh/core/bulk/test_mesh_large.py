"""Large messages of flood and unicast beside members that lie and any sequence of accidents."""

from collections.abc import Sequence

import pytest
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st
from large_world import GRAPHS, idle, inject, large
from overlay_world import World, line

from services.mesh.core.actions import Transmit
from services.mesh.core.bulk import exchange, pieces, transfers
from services.mesh.core.bulk.pieces import GONE, OFFER, PIECE, SIZE, WANT, Fetch, MessageId, Packet
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import BULK, MAX_MESSAGE
from swarm.errors import FrameError
from swarm.messages import FloodRequest, SendRequest


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


@costly(60)
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
            assert fetch.waiting_since == float("inf")
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
    sent: dict[int, tuple[str, str, int]] = {}
    floods: dict[int, tuple[str, int]] = {}
    for count, (what, value, option) in enumerate(steps):
        name = world.names[int(value) % len(world.names)]
        match what:
            case "send":
                to = world.names[option % len(world.names)]
                sent[count] = (name, to, world.lives[name])
                request = SendRequest(f"t{count}", "test", to, large(count), "bulk", 100.0)
                world.step(name, lambda each, request=request: each.request(request, world.now))
            case "flood":
                floods[count] = (name, world.lives[name])
                wish = FloodRequest(f"t{count}", "test", large(count), "bulk", False)
                world.step(name, lambda each, wish=wish: each.request(wish, world.now))
            case "latest":
                key, payload = f"swarm/{name}/rule/k{option}", large(count)
                world.step(
                    name,
                    lambda each, key=key, payload=payload: each.flood(key, payload, BULK, world.now, latest=True),
                )
            case _:
                world.disturb(what, value, option)
    world.run(60.0)
    inboxes = [*world.former, *((name, bot.inbox) for name, bot in world.bots.items())]
    whole = {large(count) for count in range(len(steps))}
    for _, inbox in inboxes:
        ours = [(key, data) for key, data in inbox if len(data) > packets.UNICAST_ROOM]
        assert all(data in whole for _, data in ours), "bytes at the wrong place"
        once = [(key, data[:6]) for key, data in ours if "/rule/" not in key]
        assert len(once) == len(set(once)), "twice in one life"
        for key in {key for key, _ in ours if "/rule/" in key}:
            values = [data for each, data in ours if each == key]
            assert values == sorted(values), "an older value after a newer one"
    for count, (name, to, life) in sent.items():
        if life == world.lives[name]:
            answer = world.sent(name, f"t{count}")
            assert answer is not None, "no answer at all"
            got = any(data == large(count) for who, inbox in inboxes if who == to for _, data in inbox)
            assert got or not answer.delivered, "it says that it arrived"
    for count, (name, life) in floods.items():
        if life == world.lives[name]:
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
