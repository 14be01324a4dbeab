"""Messages between robots are counted while they are few, and not even listened to while they are many."""

from collections.abc import Callable, Sized

from hypothesis import given
from hypothesis import strategies as st

from swarm.onboard.traffic import LISTEN_S, MANY, MAX_SENDERS, REST_S, Traffic


class Bus:
    """Hears as long as somebody is subscribed."""

    def __init__(self) -> None:
        self.callback: Callable[[str, bytes], None] | None = None
        self.begun = 0

    def subscribe(self, keys: tuple[str, ...], callback: Callable[[str, bytes], None]) -> "Bus":
        assert self.callback is None
        self.callback, self.begun = callback, self.begun + 1
        return self

    def close(self) -> None:
        self.callback = None

    def bring(self, sender: str, kind: str = "sync") -> bool:
        if self.callback is not None:
            self.callback(f"swarm/{sender}/app/x/{kind}/0-0-0-0", b"\1")
        return self.callback is not None


def run(rate: float, seconds: float, sender: str = "r1") -> tuple[list[tuple[str, int]], int, Bus]:
    """What is told of messages at an even rate, how many were heard, and the bus."""
    bus, told, heard = Bus(), list[tuple[str, int]](), 0
    traffic = Traffic(bus, "r0", lambda name, count: told.append((name, count)))
    for step in range(round(seconds * rate)):
        traffic.look(step / rate)
        heard += bus.bring(sender)
    return told, heard, bus


def test_few_are_told_one_by_one() -> None:
    told, heard, bus = run(MANY / 2, 10.0)
    assert heard == MANY / 2 * 10.0
    assert bus.begun == 1
    # The first are heard only to know how many there are; what is told is how many there were, with them.
    (_, first), *_ = told
    assert first <= MANY / 2 * LISTEN_S + 2
    assert told == [("r1", number) for number in range(first, heard + 1)]


def test_many_cost_nearly_nothing_and_are_not_told() -> None:
    told, heard, bus = run(10 * MANY, 60.0)
    assert told == []
    assert heard <= 10 * MANY * (LISTEN_S + 0.1) * bus.begun
    assert bus.begun <= 60.0 / (REST_S + LISTEN_S) + 2


def test_when_they_are_fewer_again_they_are_told_again() -> None:
    bus, told = Bus(), list[tuple[str, int]]()
    traffic = Traffic(bus, "r0", lambda *passed: told.append(passed))
    now = 0.0
    for rate, seconds in ((10 * MANY, 2.0), (5, REST_S + 2.0)):
        for _ in range(round(rate * seconds)):
            traffic.look(now)
            bus.bring("r1", "latest")
            now += 1.0 / rate
    assert len(told) > 3


def test_however_many_come_from_however_many_while_the_caller_is_held_up_little_is_kept() -> None:
    bus, told = Bus(), list[tuple[str, int]]()
    traffic = Traffic(bus, "r0", lambda *passed: told.append(passed))
    traffic.look(0.0)
    for number in range(2 * MAX_SENDERS):
        bus.bring("r1")
        bus.bring(f"r{number}")
    assert all(len(kept) <= MAX_SENDERS for kept in vars(traffic).values() if isinstance(kept, Sized))
    # They were few for so long a time.
    traffic.look(100.0)
    bus.bring("r1")
    assert told == [("r1", 2 * MAX_SENDERS + 2)]
    # They are many.
    for _ in range(100):
        bus.bring("r1")
    traffic.look(101.0)
    assert not bus.bring("r1")


@given(st.lists(st.tuples(st.text(max_size=20), st.sampled_from(["r0", "r1", "R 9"])), max_size=20))
def test_nothing_that_a_bus_brings_harms_it_and_the_own_messages_are_left_out(said: list[tuple[str, str]]) -> None:
    bus, told = Bus(), list[tuple[str, int]]()
    traffic = Traffic(bus, "r0", lambda *passed: told.append(passed))
    traffic.look(0.0)
    traffic.look(LISTEN_S)
    for key, sender in said:
        assert bus.callback is not None
        bus.callback(key, b"")
        bus.bring(sender)
    assert {sender for sender, _ in told} <= {"r1"}
    assert len(told) == sum(sender == "r1" for _, sender in said)
