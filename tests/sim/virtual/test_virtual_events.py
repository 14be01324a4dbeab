"""The event queue: order of time, then of planning; and nothing before its time."""

from hypothesis import given
from hypothesis import strategies as st

from sim.virtual.events import EventQueue

TIMES = st.lists(st.sampled_from((0.0, 0.5, 1.0, 1.5, 2.0, 3.5)), max_size=30)


@given(TIMES, st.sampled_from((0.4, 1.0, 2.0, 9.0)))
def test_calls_come_in_the_order_of_time_and_then_of_planning(times, until):
    queue, seen = EventQueue(), []
    for number, time in enumerate(times):
        queue.at(time, lambda time, number: seen.append((queue.now, time, number)), time, number)
    assert queue.run(until)
    assert queue.now == until
    planned = sorted((time, number) for number, time in enumerate(times))
    assert seen == [(time, time, number) for time, number in planned if time <= until]
    queue.run()
    assert len(seen) == queue.done == len(times)


@given(TIMES, TIMES)
def test_what_is_planned_for_the_past_happens_now_and_behind_what_was_planned_before(first, second):
    queue, seen = EventQueue(), []

    def plan():
        for time in second:
            queue.at(time, lambda: seen.append(queue.now))

    queue.at(1.5, plan)
    for time in first:
        queue.at(time, lambda: seen.append(queue.now))
    queue.run()
    assert seen == sorted(seen)
    assert len(seen) == len(first) + len(second)
    assert min(seen, default=2.0) >= min([*first, 1.5])


def test_soon_is_this_moment_but_never_within_the_present_call():
    queue, seen = EventQueue(), []

    def outer():
        queue.soon(seen.append, "soon")
        queue.at(queue.now, seen.append, "at")
        seen.append("outer")

    queue.at(1.0, outer)
    queue.at(1.0, seen.append, "next")
    queue.run()
    assert seen == ["outer", "soon", "next", "at"]


def test_a_run_can_be_stopped_and_go_on():
    queue, seen = EventQueue(), []
    queue.at(1.0, queue.stop)
    queue.at(1.0, seen.append, "later")
    assert not queue.run(5.0)
    assert (queue.now, seen) == (1.0, [])
    assert queue.run(5.0)
    assert (queue.now, seen) == (5.0, ["later"])
