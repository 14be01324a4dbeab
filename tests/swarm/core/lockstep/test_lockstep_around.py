"""Lockstep: a neighbour whose link carries nothing is talked to around it."""

import pytest
from lockstep_core import THEIRS, at, started, step_of, wants
from lockstep_world import EDGES, World, named

from swarm.core.lockstep.actions import Send, address_of, key_of
from swarm.core.lockstep.frames import (
    encode_step,
    encode_want,
)


def asked(neighbours=("r1", "r2")):
    """Has asked all its neighbours for x(1), 0.2 s after it was there."""
    one = at(1, neighbours)
    one.handle_timer(0.2)
    one.actions()
    return one


def test_who_does_not_answer_is_talked_to_around_its_link():
    one = asked()
    one.receive("r2", THEIRS, step_of(0), 0.25)  # it waits for others, but can be heard
    assert one.next_deadline() == pytest.approx(0.2 + 0.1)
    one.handle_timer(0.3001)
    assert one.actions() == [
        Send(encode_step(1, b"a1", b"a0"), "r1", around=True),
        Send(encode_want(1), "r1", around=True),
    ]
    assert one.counters["links gone around"] == 1
    assert one.next_deadline() == pytest.approx(0.4)


def test_a_slow_link_has_one_and_a_half_round_trips_to_answer():
    one = at(1, rtt=0.5)
    one.handle_timer(1.5)
    assert wants(one.actions()) == [("r1", encode_step(1, b"a1", b"a0")), ("r1", encode_want(1))]
    assert one.next_deadline() == pytest.approx(1.5 + 1.5 * 0.5)


def test_at_the_first_iteration_nothing_goes_around_before_who_is_waited_for_is_named():
    one = started()
    sent = []
    while one.next_deadline() < 2.499:
        one.handle_timer(one.next_deadline())
        sent += [action for action in one.actions() if isinstance(action, Send)]
    assert sent
    assert not any(action.around for action in sent)
    assert one.next_deadline() == pytest.approx(2.5)
    one.handle_timer(2.501)
    assert [action.around for action in one.actions() if isinstance(action, Send)] == [True, True]


def test_what_follows_goes_around_at_once_until_the_link_speaks():
    one = asked()
    one.handle_timer(0.38)
    one.actions()
    for peer in ("r1", "r2"):
        one.receive(peer, THEIRS, step_of(1), 0.5, around=True)
    one.computed(b"a2", b"", 0.5)
    frame = encode_step(2, b"a2", b"a1")
    sends = [action for action in one.actions() if isinstance(action, Send)]
    assert sends == [Send(frame, None), Send(frame, "r1", around=True), Send(frame, "r2", around=True)]
    one.receive("r1", THEIRS, step_of(2), 0.6)
    one.receive("r2", THEIRS, step_of(2), 0.7, around=True)
    one.computed(b"a3", b"", 0.7)
    sends = [action for action in one.actions() if isinstance(action, Send)]
    assert sends == [Send(encode_step(3, b"a3", b"a2"), None), Send(encode_step(3, b"a3", b"a2"), "r2", around=True)]


def test_who_comes_around_with_what_is_missing_is_answered_around():
    one = at(1, ("r1", "r2"))
    one.receive("r2", THEIRS, step_of(1), 0.04)
    one.receive("r1", THEIRS, step_of(1), 0.1, around=True)
    one.computed(b"a2", b"", 0.1)
    assert Send(encode_step(2, b"a2", b"a1"), "r1", around=True) in one.actions()


def test_what_the_link_has_overtaken_changes_nothing():
    one = at(1, ("r1", "r2"))
    one.receive("r1", THEIRS, step_of(1), 0.04)
    one.receive("r1", THEIRS, step_of(1), 0.1, around=True)
    one.receive("r2", THEIRS, step_of(1), 0.1)
    one.computed(b"a2", b"", 0.1)
    assert not any(action.around for action in one.actions() if isinstance(action, Send))


def test_a_question_that_came_around_is_answered_around():
    one = at(2)
    one.receive("r1", THEIRS, encode_want(2), 1.0, around=True)
    assert one.actions() == [Send(encode_step(2, b"a2", b"a1"), "r1", around=True)]


@pytest.mark.parametrize(
    ("to", "around", "end"),
    [(None, False, ""), ("r1", False, "/r1"), ("around", False, "/around"), ("r1", True, "/r1/around")],
)
def test_the_key_of_a_frame_says_its_way(to, around, end):
    channel = f"swarm/r0/app/balance/sync/{THEIRS.text}"
    key = key_of(channel, to, around=around)
    assert key == channel + end
    assert address_of(key) == ("r0", "balance", THEIRS.text, to, around)


@pytest.mark.parametrize(
    "key",
    [
        *("", "swarm/stop", "swarm/r0/app/a/sync", "swarm/r0/app/a/latest/c", "swarm/r0/mesh/a/sync/c"),
        *("swarm/r0/app/a/sync/c/r1/x", "swarm/r0/app/a/sync/c/r1/around/x"),
    ],
)
def test_other_keys_are_no_frames(key):
    assert address_of(key) is None


def test_keys_that_are_made_up_cost_no_memory():
    for number in range(1000):
        address_of(f"swarm/r0/app/a/sync/{number}")
        address_of(f"no frame's {number}")
    assert address_of.cache_info().currsize <= 256


def test_a_loop_goes_on_around_a_link_that_carries_nothing():
    world = World(named(EDGES["loop"](4)), 60)
    world.start_all()
    world.run(0.5)
    world.cut_link(("r0", "r1"))
    assert world.run(60 * 0.2, until=world.finished)
    assert world.around > 0


def test_a_line_has_no_way_around_and_waits():
    world = World(named(EDGES["line"](4)), 60)
    world.start_all()
    world.run(0.5)
    world.cut_link(("r1", "r2"))
    assert not world.run(30.0, until=world.finished)
    world.mend_link(("r1", "r2"))
    assert world.run(5.0, until=world.finished)
