"""What floods leave to robots that were away: nothing is missed for good, and the store is bounded."""

import itertools
from collections.abc import Sequence

import pytest
from conftest import costly
from hypothesis import example, given
from hypothesis import strategies as st
from overlay_world import FLOOD_KEY, GRAPHS, World, line, ring

from services.mesh.core.overlays import echo, flood_store
from services.mesh.core.wire import packets
from services.mesh.core.wire.frames import BULK, CONTROL, FLOOD
from services.mesh.core.wire.packets import Spread


def publish(world: World, name: str, topic: str, payload: bytes, *, latest: bool = True) -> None:
    world.step(name, lambda each: each.flood(f"swarm/{name}/rule/{topic}", payload, BULK, world.now, latest=latest))


def test_a_joiner_gets_the_latest_values() -> None:
    world = World(line(4), start=False)
    for name in ("r0", "r1", "r2"):
        world.start(name)
    world.run(1.0)
    for value in (b"old", b"new"):
        publish(world, "r0", "x", value)
    publish(world, "r0", "once", b"missed", latest=False)
    world.run(1.0)
    world.start("r3")
    world.run(1.0)
    assert world.got("r3", "/rule/x") == [b"new"]
    assert world.got("r3", "/rule/once") == []
    assert world.states("r0")["r3"] == "here"


def test_parts_of_a_swarm_catch_up_when_they_meet() -> None:
    world = World(line(4))
    world.settle()
    world.cut("r1", "r2")
    world.run(1.0)
    for name in world.names:
        publish(world, name, "x", name.encode())
    world.run(1.0)
    world.join("r1", "r2")
    world.run(1.0)
    for name in world.names:
        assert set(world.got(name, "/rule/x")) == {each.encode() for each in world.names if each != name}
        assert len(world.got(name, "/rule/x")) == 3


def test_what_full_queues_lost_is_repaired_by_comparing() -> None:
    world = World(ring(5), seed=3)
    world.settle()
    world.loss = 0.7
    for n in range(20):
        publish(world, "r0", f"x{n}", b"%d" % n)
    world.run(1.0)
    world.loss = 0.0
    world.run(2.5 * flood_store.COMPARE_PERIOD)
    for name in world.names[1:]:
        assert sorted(world.got(name, "")) == sorted(b"%d" % n for n in range(20))


def test_a_robot_whose_clock_went_back_goes_above_its_old_self() -> None:
    world = World(line(3))
    world.settle()
    publish(world, "r0", "x", b"old")
    world.run(1.0)
    world.kill("r0")
    world.clock_error["r0"] = -500.0
    world.start("r0")
    publish(world, "r0", "x", b"new")
    world.run(2.0)
    for name in ("r1", "r2"):
        assert world.got(name, "/rule/x")[-1] == b"new"
        assert world.states(name)["r0"] == "here"
    ticket = world.flood("r0", b"hello")
    world.run(1.0)
    answer = world.flooded("r0", ticket)
    assert answer is not None
    assert answer.robots == ("r1", "r2")


def test_a_forged_number_blocks_nobody_for_good() -> None:
    """A member can speak for r0. r0 hears of it and begins anew above it."""
    world = World(line(3))
    world.settle()
    forged = packets.encode_spread(Spread(2**62, 2**31, b"forged"))
    world.step("r1", lambda each: each.receive("r2", FLOOD, FLOOD_KEY.format("r0"), forged, BULK, world.now))
    world.run(0.5)
    assert world.got("r1", "/flood") == [b"forged"]
    ticket = world.flood("r0", b"genuine")
    world.run(1.0)
    answer = world.flooded("r0", ticket)
    assert answer is not None
    assert answer.robots == ("r1", "r2")
    assert world.got("r1", "/flood")[-1] == b"genuine"


accidents = st.lists(
    st.one_of(
        st.tuples(st.just("flood"), st.integers(0, 5), st.just(0)),
        st.tuples(st.just("latest"), st.integers(0, 5), st.integers(0, 2)),
        st.tuples(st.just("cut"), st.integers(0, 20), st.integers(0, 1)),
        st.tuples(st.just("join"), st.integers(0, 20), st.just(0)),
        st.tuples(st.just("restart"), st.integers(0, 5), st.just(0)),
        st.tuples(st.just("wait"), st.floats(0.001, 1.5), st.just(0)),
    ),
    max_size=40,
)


def disturb(world: World, steps: Sequence[tuple[str, float, int]], sent: list[tuple[str, bytes]]) -> None:
    for count, (what, value, option) in enumerate(steps):
        match what:
            case "flood":
                name = world.names[int(value) % len(world.names)]
                sent.append((name, b"%d" % count))
                world.flood(name, b"%d" % count, ticket=f"t{count}")
            case "latest":
                publish(world, world.names[int(value) % len(world.names)], f"k{option}", b"%d" % count)
            case _:
                world.disturb(what, value, option)


@costly(60)
@given(accidents, st.sampled_from(sorted(GRAPHS)), st.floats(0.0, 0.02), st.integers(0, 99))
def test_whatever_happens_once_to_each_and_all_agree_in_the_end(
    steps: list[tuple[str, float, int]], graph: str, jitter: float, seed: int
) -> None:
    world = World(GRAPHS[graph], jitter=jitter, seed=seed)
    world.run(1.0)
    sent: list[tuple[str, bytes]] = []
    newest: dict[str, bytes] = {}
    published: dict[int, tuple[str, str, bytes]] = {}
    for count, (what, value, option) in enumerate(steps):
        if what == "latest":
            published[count] = (world.names[int(value) % len(world.names)], f"k{option}", b"%d" % count)
        if what == "restart":  # what a robot has said in an earlier life is void
            gone = world.names[int(value) % len(world.names)]
            published = {at: entry for at, entry in published.items() if entry[0] != gone}
    disturb(world, steps, sent)
    for name, topic, payload in published.values():
        newest[f"swarm/{name}/rule/{topic}"] = payload
    world.run(4.0)
    for edge in world.edges:
        world.join(*sorted(edge))
    world.run(2.5 * flood_store.COMPARE_PERIOD)
    for name, bot in world.bots.items():
        floods = [(key.split("/")[1], payload) for key, payload in bot.inbox if key.endswith("/flood")]
        assert len(floods) == len(set(floods)), "delivered twice"
        assert set(floods) <= set(sent)
        for key, payload in newest.items():
            if key.split("/")[1] != name:
                values = [data for each, data in bot.inbox if each == key]
                assert values[-1:] == [payload], f"{name} lacks {key}"
                assert values == sorted(values, key=int), "an older value after a newer one"
        assert len(bot.overlays._flood._waves) <= echo.MAX_WAVES
    # Every flood of a robot that lived on has had its answer, and a new one is complete.
    for count, (what, value, _) in enumerate(steps):
        name = world.names[int(value) % len(world.names)]
        if what == "flood" and not any(
            later == "restart" and world.names[int(other) % len(world.names)] == name
            for later, other, _ in steps[count:]
        ):
            assert world.flooded(name, f"t{count}") is not None
    world.clear()
    for name in world.names:
        ticket = world.flood(name, b"end", ticket=f"end-{name}")
        world.run(1.0)
        answer = world.flooded(name, ticket)
        assert answer is not None
        assert set(answer.robots) == set(world.names) - {name}
        assert answer.complete


@costly(60)
@given(st.binary(max_size=60), st.sampled_from((FLOOD_KEY.format("r0"), "swarm/r1/mesh/digest", "swarm/r1/mesh/lsa",
                                                "swarm/r2/mesh/lsa", "swarm/r1/mesh/halt", "swarm/r1/mesh/unicast")),
       st.integers(0, 5))  # fmt: skip
@example(bytes(8) + b"\1\0\0\0\1", "swarm/r1/mesh/lsa", 1)  # a flood of r1 with an incarnation far above its own
@example(b"\x08" + bytes(7) + b"\1\0\0\0\1\0\0\x10\0", "swarm/r1/mesh/lsa", 1)  # the same, announced
@example(b"\1" + bytes(7) + b"\1\0\0\0\1", "swarm/r1/mesh/digest", 1)  # the same, of which it wants echoes
@example(bytes(8) + b"\1\0\0\0\1", "swarm/r1/mesh/halt", 1)
def test_any_packet_of_a_member_is_taken_or_counted(data: bytes, key: str, kind: int) -> None:
    world = World(line(3))
    world.settle()
    overlay = 2 if key.endswith("unicast") else FLOOD
    packet = bytes((kind,)) + data
    world.step("r0", lambda each: each.receive("r1", overlay, key, packet, CONTROL, world.now))
    world.run(10.0)
    assert world.states("r1")["r0"] == "here"
    ticket = world.flood("r1", b"still alive")
    world.run(1.0)
    answer = world.flooded("r1", ticket)
    assert answer is not None
    assert answer.complete


def test_the_store_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flood_store, "KEPT_EACH", 10)
    monkeypatch.setattr(flood_store, "KEPT_BYTES", 4000)
    kept = flood_store.Store()
    taken = 0
    for sequence in range(1, 200):
        packet = Spread(1, sequence, bytes(sequence % 50 * 40), latest=True)
        taken += kept.take(f"r{sequence % 3}", f"k{sequence % 40}", packet, BULK) == flood_store.NEW
        assert kept.take(f"r{sequence % 3}", f"k{sequence % 40}", packet, BULK) == flood_store.DUPLICATE
        assert kept._bytes == sum(each.size for name in ("r0", "r1", "r2") for _, each in kept.kept(name))
        assert kept._bytes <= 4000
        assert len(kept) <= 30
    assert taken == 199, "what is not kept is carried all the same"
    assert kept.unkept


def test_any_two_stores_with_other_values_have_other_checksums() -> None:
    """Numbers that differ by the same bits in two keys, or in two origins, do not cancel each other out."""
    numbers = range(1, 12)
    checksums, summaries = set(), set()
    for first, second in itertools.product(numbers, numbers):
        kept = flood_store.Store()
        for name in ("r0", "r1"):
            for key, sequence in ((f"swarm/{name}/mesh/lsa", first), (f"swarm/{name}/mesh/stopped", 20 + second)):
                kept.take(name, key, Spread(1, sequence, b"", latest=True), BULK)
            checksums.add(kept.digest()[name])
        summaries.add(kept.summary())
        other = flood_store.Store()
        for name, sequence in (("r0", first), ("r1", second)):
            other.take(name, f"swarm/{name}/rule/x", Spread(1, sequence, b"", latest=True), BULK)
        summaries.add(other.summary())
    assert len(checksums) == 2 * len(numbers) ** 2
    assert len(summaries) == 2 * len(numbers) ** 2


def test_what_is_forgotten_does_not_come_back() -> None:
    kept = flood_store.Store()
    packet = Spread(5, 3, b"x", latest=True)
    assert kept.take("r0", "k", packet, BULK) == flood_store.NEW
    kept.forget("r0")
    assert kept.kept("r0") == []
    assert kept.take("r0", "k", packet, BULK) == flood_store.DUPLICATE
    assert kept.take("r0", "k", packet._replace(sequence=4), BULK) == flood_store.NEW


def test_what_was_missed_long_ago_is_new_and_what_is_older_than_the_kept_value_is_not() -> None:
    kept = flood_store.Store()
    assert kept.take("r0", "often", Spread(1, 5000, b"x", latest=True), BULK) == flood_store.NEW
    assert kept.take("r0", "rare", Spread(1, 3, b"y", latest=True), BULK) == flood_store.NEW
    assert kept.take("r0", "often", Spread(1, 4999, b"older", latest=True), BULK) == flood_store.DUPLICATE
    assert kept.take("r0", "plain", Spread(1, 4, b"z"), BULK) == flood_store.DUPLICATE


def test_a_robot_that_is_back_has_its_unchanged_values_kept_again() -> None:
    kept = flood_store.Store()
    packet = Spread(1, 5, b"value", latest=True)
    assert kept.take("r1", "key", packet, BULK) == flood_store.NEW
    kept.forget("r1")
    assert kept.take("r1", "key", packet, BULK) == flood_store.DUPLICATE
    kept.take_again("r1")
    assert kept.take("r1", "key", packet, BULK) == flood_store.NEW
    assert [key for key, _ in kept.kept("r1")] == ["key"]
