"""The asynchronous overlay of one robot: its frames, the order of an app's handlers, its steps."""

from typing import Any

import pytest
from asynchronous_world import SIZE
from hypothesis import given
from hypothesis import strategies as st

from swarm.core.asynchronous import (
    DEAD_AFTER,
    HANG,
    MAX_QUEUE,
    MAX_QUEUE_BYTES,
    MIN_GAP,
    REPEAT,
    REPEAT_WAITING,
    Asynchronous,
    HandlerCall,
    NeighbourState,
    Publish,
)
from swarm.core.lockstep.frames import Channel

NAMES = ("r0", "r1", "r2")


def core(me: str = "r1", **options: Any) -> Asynchronous:
    neighbours = {"r0": ("r1",), "r1": ("r0", "r2"), "r2": ("r1",)}[me]
    return Asynchronous(me, neighbours, Channel(7, 0, 1, 1), SIZE, NAMES, **options)


def started(now: float = 0.0, **options: Any) -> Asynchronous:
    """One whose start() has returned."""
    each = core(**options)
    each.begin(now)
    assert each.actions() == [HandlerCall("start")]
    each.returned(b"\0\0", now)
    return each


def frame(state: bytes, sequence: int = 1, *, all_here: bool = True, roll: int = 0) -> bytes:
    return bytes((all_here,)) + sequence.to_bytes(4, "little") + state + (b"" if all_here else bytes((roll,)))


def calls(each: Asynchronous) -> list[HandlerCall]:
    return [action for action in each.actions() if isinstance(action, HandlerCall)]


def frames(each: Asynchronous) -> list[bytes]:
    return [action.data for action in each.actions() if isinstance(action, Publish)]


# Frames


def test_a_frame_byte_for_byte() -> None:
    each = started()
    assert frames(each) == [bytes.fromhex("00 01000000 0000 02")]  # r1 alone has been there: bit 1
    each.receive("r0", Channel(7, 0, 1, 1), frame(b"ab", all_here=False, roll=0b101), 0.5)
    each.handle_timer(0.5)
    assert frames(each) == [bytes.fromhex("01 02000000 0000")]  # and now all have


@pytest.mark.parametrize(
    ("channel", "data", "counter"),
    [
        (Channel(8, 0, 1, 1), frame(b"ab"), "other_run"),
        (Channel(7, 0, 1, 2), frame(b"ab"), "other_version"),
        (Channel(7, 0, 1, 1), b"", "bad_frame"),
        (Channel(7, 0, 1, 1), frame(b"abc"), "bad_frame"),
        (Channel(7, 0, 1, 1), b"\x02" + frame(b"ab")[1:], "bad_frame"),
        (Channel(7, 0, 1, 1), frame(b"ab", all_here=False, roll=0b1001), "bad_frame"),
        (Channel(7, 0, 1, 1), frame(b"ab", 0), "duplicate"),
    ],
)
def test_frames_that_are_none_or_not_for_us_are_counted(channel: Channel, data: bytes, counter: str) -> None:
    each = started()
    each.receive("r0", Channel(7, 0, 1, 1), frame(b"xy", 3), 0.0)
    each.receive("r0", channel, data, 1.0)
    assert each.counters == {counter: 1}
    assert each.known(1.0) == [NeighbourState("r0", b"xy", 1.0)]


def test_who_is_no_neighbour_is_not_heard() -> None:
    each = started(me="r0")
    each.receive("r2", Channel(7, 0, 1, 1), frame(b"ab"), 0.0)
    assert each.counters == {"not_a_neighbour": 1}


@given(st.binary(max_size=12))
def test_any_bytes_are_taken_or_counted(data: bytes) -> None:
    each = started()
    each.receive("r0", Channel(7, 0, 1, 1), data, 0.0)
    assert bool(each.known(0.0)) != bool(each.counters)


def test_a_dead_process_is_not_heard_after_its_successor() -> None:
    each = started()
    each.receive("r0", Channel(7, 0, 2, 1), frame(b"ne"), 0.0)
    each.receive("r0", Channel(7, 0, 1, 1), frame(b"ol", 99), 0.0)
    assert each.known(0.0) == [NeighbourState("r0", b"ne", 0.0)]
    assert each.counters == {"dead_process": 1}


def test_a_robot_with_a_new_card_is_heard_though_it_counts_its_starts_anew() -> None:
    each = started()
    each.receive("r0", Channel(7, 0, 9, 1), frame(b"ol", 99), 0.0)
    each.receive("r0", Channel(7, 0, 1, 1), frame(b"ne"), DEAD_AFTER - 0.1)
    assert each.known(DEAD_AFTER)[0].data == b"ol"
    each.receive("r0", Channel(7, 0, 1, 1), frame(b"ne", 2), DEAD_AFTER)
    assert each.known(DEAD_AFTER) == [NeighbourState("r0", b"ne", 0.0)]


def test_robots_with_another_version_are_named_until_they_have_ours() -> None:
    each = started()
    each.receive("r0", Channel(7, 0, 1, 99), frame(b"abcd"), 0.0)
    assert each.strangers == ("r0",)
    assert each.known(0.0) == []
    each.receive("r0", Channel(7, 0, 2, 1), frame(b"ab"), 0.0)
    assert each.strangers == ()
    assert each.known(0.0) == [NeighbourState("r0", b"ab", 0.0)]


def test_neighbours_may_change_and_the_new_ones_are_told_at_once() -> None:
    each = started(handled=())
    each.receive("r0", Channel(7, 0, 1, 1), frame(b"ab"), 0.0)
    each.receive("r2", Channel(7, 0, 1, 1), frame(b"cd"), 0.0)
    each.handle_timer(0.5)
    each.actions()
    each.set_neighbours(("r2", "r5"), 0.6)
    each.handle_timer(0.6)
    assert len(frames(each)) == 1
    each.receive("r0", Channel(7, 0, 1, 1), frame(b"ab", 2), 0.7)
    each.receive("r5", Channel(7, 0, 1, 1), frame(b"ef"), 0.7)
    assert [(known.name, known.data) for known in each.known(0.7)] == [("r2", b"cd"), ("r5", b"ef")]
    assert each.counters == {"not_a_neighbour": 1}


# When the state is told


def test_the_state_goes_out_when_it_changed_and_each_second() -> None:
    each = started()
    assert len(frames(each)) == 1
    each.receive("r0", Channel(7, 0, 1, 1), frame(b"ab"), 1.0)
    each.handle_timer(1.0)
    each.actions()
    each.happened("on_button", "a", now=1.2)
    each.returned(b"\0\1", 1.2)
    assert [data[5:7] for data in frames(each)] == [b"\0\1"]
    each.happened("on_button", "a", now=1.3)
    each.returned(b"\0\1", 1.3)
    assert frames(each) == []  # the same
    assert each.next_deadline() == pytest.approx(1.2 + REPEAT)
    each.handle_timer(1.2 + REPEAT)
    assert len(frames(each)) == 1


def test_a_state_that_changes_too_often_is_told_now_and_then_and_at_last() -> None:
    each = started()
    told = frames(each)
    for number in range(1, 36):
        now = number * MIN_GAP / 10
        each.happened("on_button", "a", now=now)
        each.returned(bytes((0, number)), now)
        told += [action.data for action in each.actions() if isinstance(action, Publish)]
    assert len(told) == 4
    each.handle_timer(1.0)
    assert frames(each)[0][5:7] == bytes((0, 35))


# The order of handlers


def test_handlers_run_one_at_a_time_in_order_and_start_comes_first() -> None:
    each = core()
    each.receive("r0", Channel(7, 0, 1, 1), frame(b"ab"), 0.0)
    each.happened("on_button", "a", now=0.0)
    assert calls(each) == []
    each.begin(0.0)
    assert calls(each) == [HandlerCall("start")]
    each.returned(b"\0\0", 0.0)
    assert calls(each) == [HandlerCall("on_neighbour", ("r0",))]
    each.happened("on_button", "b", now=0.0)
    assert calls(each) == []
    each.returned(b"\0\0", 0.0)
    assert calls(each) == [HandlerCall("on_button", ("a",))]
    each.returned(b"\0\0", 0.0)
    assert calls(each) == [HandlerCall("on_button", ("b",))]
    assert each.k == 2


def test_of_a_neighbours_states_only_the_newest_counts() -> None:
    each = started()
    each.happened("on_button", "a", now=0.0)
    for number in range(1, 4):
        each.receive("r0", Channel(7, 0, 1, 1), frame(bytes((0, number)), number), 0.0)
    each.actions()
    each.returned(b"\0\0", 0.0)
    assert calls(each) == [HandlerCall("on_neighbour", ("r0",))]
    each.returned(b"\0\0", 0.0)
    each.receive("r0", Channel(7, 0, 1, 1), frame(bytes((0, 3)), 4), 0.0)
    assert calls(each) == []  # told again, but the same


def test_handlers_that_the_app_has_not_are_not_called() -> None:
    each = started(handled=("on_button",))
    each.receive("r0", Channel(7, 0, 1, 1), frame(b"ab"), 0.0)
    each.happened("on_message", "x", now=0.0)
    each.happened("on_button", "a", now=0.0)
    assert calls(each) == [HandlerCall("on_button", ("a",))]


def test_too_many_events_lose_the_oldest() -> None:
    each = started()
    for number in range(MAX_QUEUE + 3):
        each.happened("on_button", number, now=0.0)
    assert each.counters["lost_events"] == 2  # one is running
    each.actions()
    each.returned(b"\0\0", 0.0)
    assert calls(each) == [HandlerCall("on_button", (3,))]


def test_a_full_queue_loses_no_timer() -> None:
    """An app may plan its next timer in the handler of this one."""
    each = started()
    each.happened("on_button", "first", now=0.0)
    each.after(0.5, "blink", 0.0)
    each.handle_timer(0.5)
    for number in range(MAX_QUEUE + 3):
        each.happened("on_button", number, now=0.6)
    each.actions()
    each.returned(b"\0\0", 0.7)
    assert calls(each) == [HandlerCall("on_timer", ("blink",))]


def test_messages_that_wait_are_bounded_by_their_bytes() -> None:
    each = started()
    size = MAX_QUEUE_BYTES // 4
    for number in range(10):
        each.happened("on_message", number, now=0.0, size=size)
    assert each.counters["lost_events"] == 5  # one is running, four wait
    each.actions()
    each.returned(b"\0\0", 0.0)
    assert calls(each) == [HandlerCall("on_message", (6,), size)]


def test_a_timer_calls_its_handler_when_it_is_due() -> None:
    each = started()
    each.actions()
    each.after(0.5, "blink", 0.0)
    each.after(0.7, "other", 0.0)
    each.after(0.6, "blink", 0.0)  # moved
    assert each.next_deadline() == pytest.approx(REPEAT_WAITING) or each.next_deadline() == pytest.approx(0.6)
    each.handle_timer(0.55)
    assert calls(each) == []
    each.handle_timer(0.6)
    assert calls(each) == [HandlerCall("on_timer", ("blink",))]
    each.handle_timer(0.8)
    each.returned(b"\0\0", 0.8)
    assert calls(each) == [HandlerCall("on_timer", ("other",))]


# Steps


def alone(**options: Any) -> Asynchronous:
    each = Asynchronous("r0", (), Channel(7, 0, 1, 1), SIZE, ("r0",), period=0.1, barrier=True, **options)
    each.begin(0.0)
    each.actions()
    each.returned(b"\0\0", 0.0)
    return each


def test_steps_come_at_the_period_and_missed_ones_are_not_made_up_for() -> None:
    each = alone()
    assert calls(each) == [HandlerCall("step")]
    each.returned(b"\0\1", 0.01)
    each.handle_timer(0.1)
    assert calls(each) == [HandlerCall("step")]
    each.returned(b"\0\2", 0.35)  # it took two periods and a half
    assert calls(each) == [HandlerCall("step")]
    assert each.counters["late_steps"] == 1
    each.returned(b"\0\3", 0.36)
    assert calls(each) == []
    each.handle_timer(0.4)
    assert calls(each) == [HandlerCall("step")]


def test_the_period_can_be_changed() -> None:
    each = alone()
    each.returned(b"\0\1", 0.0)
    each.set_period(0.5, 0.05)
    each.actions()
    each.handle_timer(0.5)
    assert calls(each) == []
    each.handle_timer(0.55)
    assert calls(each) == [HandlerCall("step")]


def test_after_the_last_step_it_is_done_and_its_state_is_told_on() -> None:
    each = alone(last=2)
    each.actions()
    each.returned(b"\0\1", 0.0)
    each.handle_timer(0.1)
    each.actions()
    each.returned(b"\0\2", 0.1)
    assert (each.phase, each.k) == ("done", 2)
    each.happened("on_button", "a", now=0.2)
    each.handle_timer(5.0)
    assert calls(each) == []
    each.handle_timer(7.0)
    assert frames(each)[0][5:7] == b"\0\2"


def test_an_app_may_say_that_it_is_done() -> None:
    each = started()
    each.happened("on_button", "a", now=0.0)
    each.returned(b"\0\1", 0.0, finished=True)
    assert each.phase == "done"


def test_a_failed_app_is_silent() -> None:
    each = alone()
    each.fail("it raised")
    each.returned(b"\0\1", 0.0)
    each.happened("on_button", "a", now=0.0)
    each.handle_timer(10.0)
    assert (each.phase, each.actions(), each.next_deadline()) == ("fault", [], None)


def test_a_failed_app_does_not_hang() -> None:
    each = alone()
    assert calls(each) == [HandlerCall("step")]
    each.fail("it raised")
    assert not each.hangs(100.0)


def test_a_failed_app_plans_nothing_when_it_hears_of_its_neighbours() -> None:
    each = started()
    each.fail("it raised")
    each.receive("r0", Channel(7, 0, 1, 1), frame(b"ab", all_here=False, roll=0b101), 0.5)
    assert each.next_deadline() is None


def test_a_handler_that_hangs_is_seen_and_its_robot_falls_silent() -> None:
    each = alone()
    assert calls(each) == [HandlerCall("step")]
    each.handle_timer(HANG - 0.1)
    assert not each.hangs(HANG - 0.1)
    each.actions()
    assert each.hangs(HANG)
    each.handle_timer(HANG + 10.0)
    assert each.actions() == []
    assert each.next_deadline() > HANG + 10.0  # a time in the past would be planned again for ever
    each.returned(b"\0\1", HANG + 10.0)
    assert not each.hangs(HANG + 10.0)
    assert HandlerCall("step") in each.actions()
