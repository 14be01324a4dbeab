"""Neighbours' values of one iteration go to the bus together, none is lost, and the last one never waits."""

from hypothesis import given
from hypothesis import strategies as st

from services.mesh.core.events import Received
from services.mesh.core.gather import HOLD, MAX_HELD, MAX_KEYS, Gather, by_app
from services.mesh.core.wire.frames import SYNC
from swarm.core.lockstep_frames import Channel, encode_step, encode_want

CHANNEL = Channel(0xA1, 0, 3, 0x9F3C21AA).text


def step(peer: str, k: int, channel: str = CHANNEL, to: str = "") -> Received:
    key = f"swarm/{peer}/app/consensus/sync/{channel}" + (f"/{to}" if to else "")
    return Received(key, encode_step(k, b"x", b"y" if k else None), SYNC)


def begun(*peers: str) -> Gather:
    """All of them have been heard at iteration 0."""
    gather = Gather()
    for peer in peers:
        assert gather.add(peer, step(peer, 0), 0.0) == [step(peer, 0)]
    return gather


def test_values_of_an_iteration_wait_for_the_last_one() -> None:
    gather = begun("r1", "r2", "r3")
    assert gather.add("r2", step("r2", 1), 1.0) == []
    assert gather.next_deadline() == 1.0 + HOLD
    assert gather.add("r1", step("r1", 1), 1.001) == []
    # One that is ahead already: it has heard all of its own neighbours.
    assert gather.add("r2", step("r2", 2), 1.002) == []
    assert gather.add("r3", step("r3", 1), 1.003) == [step("r2", 1), step("r1", 1), step("r2", 2), step("r3", 1)]
    assert gather.next_deadline() == float("inf")
    assert gather.add("r1", step("r1", 2), 1.04) == []
    assert gather.add("r3", step("r3", 2), 1.05) == [step("r1", 2), step("r3", 2)]


def test_who_does_not_come_is_not_waited_for_again_until_it_is_heard() -> None:
    gather = begun("r1", "r2")
    assert gather.add("r1", step("r1", 1), 1.0) == []
    assert gather.handle_timer(1.0 + HOLD / 2) == []
    assert gather.handle_timer(1.0 + HOLD) == [step("r1", 1)]
    assert gather.add("r1", step("r1", 2), 2.0) == [step("r1", 2)]
    assert gather.add("r2", step("r2", 1), 2.01) == [step("r2", 1)]
    assert gather.add("r1", step("r1", 3), 3.0) == []
    assert gather.add("r2", step("r2", 2), 3.01) == [step("r1", 3), step("r2", 2)]
    assert gather.add("r2", step("r2", 3), 3.015) == [step("r2", 3)]


def test_a_lost_neighbour_is_not_waited_for() -> None:
    gather = begun("r1", "r2")
    assert gather.add("r1", step("r1", 1), 1.0) == []
    assert gather.lost("r2") == [step("r1", 1)]
    assert gather.lost("r2") == []
    assert gather.add("r1", step("r1", 2), 1.1) == [step("r1", 2)]


def test_all_else_goes_on_at_once_with_what_waits() -> None:
    want = Received(f"swarm/r2/app/consensus/sync/{CHANNEL}/r0", encode_want(1), SYNC)
    strange = Received(f"swarm/r2/app/consensus/sync/{CHANNEL}", b"?", SYNC)
    for message in (want, strange, step("r2", 1, to="r0"), step("r2", 0)):
        gather = begun("r1", "r2")
        assert gather.add("r1", step("r1", 1), 1.0) == []
        assert gather.add("r2", message, 1.0) == [step("r1", 1), message]
    notes = Received("swarm/r2/app/consensus/sync/00000000000000a1-9f3c21aa-epochs", b"note", SYNC)
    other = Received("swarm/r2/app/x/latest/1", b"1", SYNC)
    gather = begun("r1", "r2")
    assert gather.add("r1", step("r1", 1), 1.0) == []
    assert [gather.add("r2", message, 1.0) for message in (notes, other)] == [[notes], [other]]


def test_locksteps_do_not_wait_for_each_other() -> None:
    gather = begun("r1", "r2")
    other = Channel(0xA1, 1, 3, 0x9F3C21AA).text
    assert gather.add("r1", step("r1", 1), 1.0) == []
    assert gather.add("r2", step("r2", 7, other), 1.0) == [step("r2", 7, other)]
    # Another process of the same robot in the same lockstep.
    again = Channel(0xA1, 0, 4, 0x9F3C21AA).text
    assert gather.add("r2", step("r2", 1, again), 1.0) == [step("r1", 1), step("r2", 1, again)]


def test_what_waits_is_bounded() -> None:
    gather = begun("r1", "r2")
    shown = [gather.add("r1", step("r1", k), 1.0) for k in range(1, MAX_HELD + 1)]
    assert shown == [[]] * (MAX_HELD - 1) + [[step("r1", k) for k in range(1, MAX_HELD + 1)]]


def test_many_keys_lose_nothing() -> None:
    gather = begun("r1", "r2")
    assert gather.add("r1", step("r1", 1), 1.0) == []
    for number in range(2 * MAX_KEYS):
        message = step("r2", 1, Channel(number, 0, 0, 0).text)
        assert gather.add("r2", message, 1.0) == [message]
    assert gather.handle_timer(1.0 + HOLD) == [step("r1", 1)]


def test_frames_by_app() -> None:
    frames = [step("r1", 1), Received("swarm/r1/app/b/sync/x/r0", b"1", SYNC), step("r2", 1)]
    others = [Received("swarm/r1/dwm/pose", b"", SYNC), Received("swarm/r1/app/b/latest/x", b"", SYNC)]
    first, second, third = ((each.key, each.payload) for each in frames)
    assert by_app([*others, *frames]) == {"consensus": [first, third], "b": [second]}


peers = st.sampled_from(["r1", "r2", "r3"])
events = st.one_of(
    st.tuples(st.just("step"), peers, st.integers(0, 6), st.booleans()),
    st.tuples(st.just("wait"), st.floats(0.0, 2 * HOLD)),
    st.tuples(st.just("lost"), peers),
)


@given(st.lists(events, max_size=60))
def test_nothing_is_lost_doubled_out_of_order_or_late(events: list[tuple[object, ...]]) -> None:
    gather, now = Gather(), 0.0
    told: list[tuple[Received, float]] = []
    shown: list[Received] = []
    for event in events:
        match event:
            case "step", str(peer), int(k), bool(to_us):
                message = step(peer, k, to="r0" if to_us else "")
                told.append((message, now))
                shown += gather.add(peer, message, now)
            case "wait", float(seconds):
                while (deadline := gather.next_deadline()) <= now + seconds:
                    now = max(now, deadline)
                    shown += gather.handle_timer(now)
                now += seconds if seconds else 0.0
            case "lost", str(peer):
                shown += gather.lost(peer)
        assert shown == [message for message, _ in told[: len(shown)]]
        assert all(now <= at + HOLD + 1e-9 or now < gather.next_deadline() for _, at in told[len(shown) :])
    shown += gather.handle_timer(now + HOLD)
    assert shown == [message for message, _ in told]
