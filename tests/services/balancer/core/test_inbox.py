"""Commands that wait in the bridge: the order, the bounds, the newest velocity, and that each loss is told."""

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from services.balancer.core.inbox import ROOM_BYTES, ROOM_EACH, Inbox, WaitingCommand

puts = st.tuples(
    st.sampled_from(["velocity", "mode", "leds"]), st.sampled_from([0, 1, 5, ROOM_BYTES // 3, ROOM_BYTES + 1])
)
steps = st.lists(st.lists(puts, max_size=40).map(tuple) | st.integers(0, 10), max_size=30)


@given(steps)
def test_inbox_keeps_order_and_bounds_and_tells_of_each_loss(steps: list[tuple | int]) -> None:
    inbox = Inbox(newest_only="velocity")
    now = 0.0
    put, taken, dropped = Counter(), [], Counter()

    for step in steps:
        if isinstance(step, int):
            taken += (some := inbox.take(step))
            assert len(some) <= step
            dropped.update(inbox.dropped())
            continue
        for name, size in step:
            now += 1.0
            put[name] += 1
            inbox.put(WaitingCommand(name, bytes(size), now))
    while some := inbox.take(7):
        taken += some
        assert sum(len(each.payload) for each in some) <= ROOM_BYTES
    dropped.update(inbox.dropped())
    assert not inbox
    heard = [each.heard for each in taken]
    assert heard == sorted(heard)
    for name in ("mode", "leds"):
        assert sum(each.name == name for each in taken) + dropped[name] == put[name]


def test_only_the_newest_velocity_waits_and_takes_its_place_in_the_order() -> None:
    inbox = Inbox(newest_only="velocity")
    for number in range(10_000):
        inbox.put(WaitingCommand("velocity", b"%d" % number, float(number)))
        if number == 5000:
            inbox.put(WaitingCommand("mode", b"stand", float(number)))
    assert [each.payload for each in inbox.take(8)] == [b"stand", b"9999"]
    assert inbox.dropped() == {}


def test_a_flood_under_one_key_leaves_room_for_the_others() -> None:
    inbox = Inbox(newest_only="velocity")
    for number in range(1000):
        inbox.put(WaitingCommand("leds", bytes(100), float(number)))
    inbox.put(WaitingCommand("mode", b"rest", 1000.0))
    taken = inbox.take(1000)
    assert [each.heard for each in taken] == [*map(float, range(ROOM_EACH)), 1000.0]
    assert inbox
    assert inbox.dropped() == {"leds": 1000 - ROOM_EACH}
    assert not inbox
