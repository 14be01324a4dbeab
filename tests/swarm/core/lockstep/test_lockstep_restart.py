"""Lockstep: a robot that is started again, and states that are lost or forked."""

import dataclasses

import pytest
from lockstep_core import OURS, THEIRS, at, core, last_save, resumed, started, step_of, wants

from swarm.core.lockstep.actions import Advanced, Compute, Fault, Send
from swarm.core.lockstep.frames import (
    encode_step,
    encode_want,
)
from swarm.core.lockstep.lockstep import Lockstep
from swarm.errors import LocalError

# Restart


def test_a_restarted_robot_sends_its_frame_asks_and_says_where_it_is():
    again, private = resumed(last_save(started(), 3))
    assert private == b"private 3"
    assert again.actions() == [
        Send(encode_step(3, b"a3", b"a2"), None),
        Advanced(3, b"a3"),
        Send(encode_want(3), "r1"),
    ]
    assert again.next_deadline() == pytest.approx(100.1)
    again.handle_timer(100.1)
    assert wants(again.actions()) == []
    assert again.next_deadline() == pytest.approx(100.2)


def test_a_compute_outstanding_at_the_kill_is_issued_again():
    one = started()
    one.receive("r1", THEIRS, step_of(0), 0.0)
    one.receive("r1", THEIRS, step_of(1), 0.0)  # it will be in the next snapshot
    again, _ = resumed(last_save(one, 1))
    assert again.actions()[-1] == Compute(1, b"a1", {"r1": b"b1"})


def test_what_was_used_is_still_compared_after_a_restart():
    again, _ = resumed(last_save(started(), 3))
    again.receive("r1", THEIRS, encode_step(2, b"zz", b"b1"), 100.0)
    assert "two values for one iteration: r1" in again.fault


def test_a_late_copy_after_a_restart_is_no_lost_state():
    again, _ = resumed(last_save(started(), 3))
    again.receive("r1", THEIRS, step_of(0), 100.0)
    assert again.fault is None


def test_a_snapshot_of_something_else_is_refused():
    saved = last_save(started(), 3)
    for neighbours, channel, size, said in (
        (("r1",), dataclasses.replace(OURS, run=1), 2, "run 00000000000000a1, this is run 0000000000000001"),
        (("r1",), dataclasses.replace(OURS, epoch=1), 2, "epoch 0, this is epoch 1"),
        (("r1",), dataclasses.replace(OURS, schema=1), 2, "schema 9f3c21aa, this is schema 00000001"),
        (("r1",), OURS, 3, "state size 2, this is state size 3"),
        (("r1", "r2"), OURS, 2, "neighbours r1, this is neighbours r1 r2"),
    ):
        with pytest.raises(LocalError, match=f"^snapshot: {said}"):
            Lockstep("r0", neighbours, channel, size).resume(saved, 0.0)
    with pytest.raises(LocalError, match="beyond the last"):
        core(last=2).resume(saved, 0.0)
    with pytest.raises(LocalError, match="truncated"):
        core().resume(saved[:-1], 0.0)


# Faults


def test_two_values_for_one_iteration():
    for k in (1, 2, 3):  # used already, to be used, ahead
        one = at(2)
        one.receive("r1", THEIRS, step_of(3 if k == 3 else 2), 0.0)
        one.actions()
        one.receive("r1", THEIRS, encode_step(k, b"zz", step_of(k)[7:]), 0.0)
        (fault,) = one.actions()
        assert fault == Fault(f"two values for one iteration: r1 sent two different states for iteration {k}")
        if k > 1:
            one.computed(b"a3", b"", 0.0)  # the answer to the step that was running does not get out
        assert one.actions() == []
        assert one.next_deadline() is None


def test_the_value_beside_is_compared_too():
    one = at(2)
    one.receive("r1", THEIRS, encode_step(2, b"b2", b"zz"), 0.0)
    assert one.actions() == [Fault("two values for one iteration: r1 sent two different states for iteration 1")]


@pytest.mark.parametrize("frame", [step_of(4), encode_want(4)])
def test_a_neighbour_two_ahead_means_that_we_lost_our_state(frame):
    one = at(2)
    one.receive("r1", THEIRS, frame, 0.0)
    assert one.actions() == [Fault("state lost at r0: r1 is at iteration 4, this robot at 2")]


@pytest.mark.parametrize("frame", [step_of(0), encode_want(0)])
def test_a_neighbour_that_came_back_too_far_behind_has_lost_its_state(frame):
    one = at(2)
    one.receive("r1", dataclasses.replace(THEIRS, incarnation=6), frame, 0.0)
    fault, *answer = one.actions()
    assert fault == Fault("state lost at r1: it came back at iteration 0 (incarnation 6), this robot is at 2")
    # The one that is lost is told, again and again, since the answer may be lost too.
    told = Send(encode_step(2, b"a2", b"a1"), "r1")
    assert answer == ([told] if frame == encode_want(0) else [])
    one.receive("r1", dataclasses.replace(THEIRS, incarnation=6), encode_want(0), 1.0)
    assert one.actions() == [told]
