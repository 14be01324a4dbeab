"""Lockstep: the single rules of one core (docs/reference/network/lockstep.md)."""

import dataclasses

import pytest
from lockstep_core import OURS, THEIRS, at, core, kinds, last_save, resumed, started, step_of, wants
from lockstep_world import RUN

from swarm.core.lockstep.actions import Advanced, Compute, Fault, Finished, Save, Send, Waiting
from swarm.core.lockstep.frames import (
    MAX_ITERATION,
    Snapshot,
    encode_step,
    encode_want,
)
from swarm.core.lockstep.lockstep import Lockstep
from swarm.errors import LocalError

# The host's side


def test_actions_come_in_the_order_of_the_rule():
    one = core(last=1)
    one.start(b"a0", 0.0, b"p")
    save, *rest = one.actions()
    assert Snapshot.decode(save.snapshot.encode()).private == b"p"
    assert rest == [Send(encode_step(0, b"a0", None), None), Advanced(0, b"a0")]
    one.receive("r1", THEIRS, step_of(0), 0.0)
    assert one.actions() == [Compute(0, b"a0", {"r1": b"b0"})]
    one.computed(b"a1", b"q", 0.0)
    save, *rest = one.actions()
    assert Snapshot.decode(save.snapshot.encode()).private == b"q"
    assert rest == [Send(encode_step(1, b"a1", b"a0"), None), Advanced(1, b"a1"), Finished(1)]


def test_values_are_sorted_by_name_whatever_the_order_of_arrival():
    one = started(("r2", "r10", "r1"))
    for name in ("r2", "r1", "r10"):
        one.receive(name, THEIRS, step_of(0), 0.0)
    (compute,) = one.actions()
    assert list(compute.values) == ["r1", "r10", "r2"]


def test_one_compute_at_a_time_while_the_next_values_arrive():
    one = started()
    one.receive("r1", THEIRS, step_of(0), 0.0)
    one.actions()
    one.receive("r1", THEIRS, step_of(1), 0.1)
    assert one.actions() == []
    one.computed(b"a1", b"", 5.0)
    assert kinds(one.actions()) == [Save, Send, Advanced, Compute]
    assert one.next_deadline() is None


def test_a_lone_robot_iterates_freely():
    one = core((), last=3)
    one.start(b"a0", 0.0)
    seen = []
    while actions := one.actions():
        seen += kinds(actions)
        if isinstance(actions[-1], Compute):
            one.computed(b"a%d" % (actions[-1].k + 1), b"", 0.0)
    assert seen == [Save, Advanced, Compute] * 3 + [Save, Advanced, Finished]
    assert one.done
    assert one.next_deadline() is None


def test_misuse_is_a_local_error():
    one = core()
    with pytest.raises(LocalError, match="comes first"):
        one.receive("r1", THEIRS, step_of(0), 0.0)
    with pytest.raises(LocalError, match="3 bytes, expected 2"):
        one.start(b"a00", 0.0)
    one.start(b"a0", 0.0)
    with pytest.raises(LocalError, match="for a new core"):
        one.start(b"a0", 0.0)
    with pytest.raises(LocalError, match="for a new core"):
        one.resume(b"", 0.0)
    with pytest.raises(LocalError, match="without a Compute"):
        one.computed(b"a1", b"", 0.0)
    with pytest.raises(LocalError, match="its own neighbour"):
        Lockstep("r0", ["r0"], OURS, 2)
    with pytest.raises(LocalError, match="last iteration"):
        core(last=MAX_ITERATION + 1)
    with pytest.raises(LocalError, match="256 neighbours"):
        core([f"n{i}" for i in range(256)])


# Who is listened to


def test_frames_of_others_are_dropped_and_counted():
    one = started()
    one.receive("r1", dataclasses.replace(THEIRS, run=RUN + 1), step_of(0), 0.0)
    one.receive("r1", dataclasses.replace(THEIRS, epoch=1), step_of(0), 0.0)
    one.receive("r1", dataclasses.replace(THEIRS, schema=1), encode_step(0, b"longer", None), 0.0)
    one.receive("r9", THEIRS, step_of(0), 0.0)
    one.receive("r0", OURS, step_of(0), 0.0)
    one.receive("r0", dataclasses.replace(OURS, incarnation=2), step_of(0), 0.0)
    assert one.counters == {"other run": 1, "other epoch": 1, "other version": 1, "unknown sender": 1, "own frame": 2}
    assert one.actions() == []
    assert one.waiting_for == ("r1",)


def test_an_older_incarnation_is_ignored():
    one = started()
    one.receive("r1", THEIRS, step_of(0), 0.0)
    one.actions()
    older = dataclasses.replace(THEIRS, incarnation=4)
    one.receive("r1", older, encode_step(1, b"zz", b"b0"), 0.0)
    one.receive("r1", older, encode_step(0, b"b0", None), 0.0)
    one.receive("r1", older, encode_want(0), 0.0)
    one.receive("r1", older, encode_step(7, b"zz", b"zz"), 0.0)
    assert one.counters == {"old incarnation": 4}
    assert one.actions() == []


@pytest.mark.parametrize(
    "frame", [encode_step(2, b"zz", b"b1"), encode_step(3, b"b3", b"zz"), encode_step(1, b"zz", b"b0")]
)
def test_a_value_that_an_older_incarnation_contradicts_is_a_fault(frame):
    """As where a member has sent one in the name of another with an incarnation that is far ahead."""
    one = at(2)
    one.receive("r1", dataclasses.replace(THEIRS, incarnation=2**64 - 1), step_of(2), 0.0, around=True)
    one.actions()
    one.receive("r1", THEIRS, frame, 0.1)
    assert "two values for one iteration: r1" in one.fault
    assert kinds(one.actions()) == [Fault]


def test_a_malformed_frame_does_not_claim_an_incarnation():
    one = started()
    one.receive("r1", dataclasses.replace(THEIRS, incarnation=99), b"junk", 0.0)
    one.receive("r1", THEIRS, step_of(0), 0.0)
    assert kinds(one.actions()) == [Compute]


# WANT


def test_what_is_missing_is_asked_for_with_the_own_frame_beside_it():
    one = at(1, ("r1", "r2"))
    one.receive("r2", THEIRS, step_of(1), 0.05)
    assert one.next_deadline() == pytest.approx(0.2)
    one.handle_timer(0.1999)
    assert one.actions() == []
    one.handle_timer(0.2)
    assert wants(one.actions()) == [("r1", encode_step(1, b"a1", b"a0")), ("r1", encode_want(1))]


def test_the_question_comes_again_for_ever_at_most_once_a_second():
    one = at(1)
    asked = []
    while len(asked) < 8:
        now = one.next_deadline()
        one.handle_timer(now)
        if sent := wants(one.actions()):
            assert len(sent) == 2
            asked.append(now)
    gaps = [b - a for a, b in zip([0.0, *asked], asked, strict=False)]
    assert gaps[:3] == pytest.approx([0.2, 0.2, 0.4])
    assert max(gaps) == pytest.approx(1.0)
    assert gaps[-1] == pytest.approx(1.0)


def test_the_first_question_waits_for_a_fifth_of_a_second_or_three_round_trips():
    one = at(1)
    one.rtt = 0.5
    assert one.next_deadline() == pytest.approx(0.2)
    one.receive("r1", THEIRS, step_of(1), 0.0)
    one.computed(b"a2", b"", 0.0)
    assert one.next_deadline() == pytest.approx(1.5)


def gone_through(one, now, k, late, *, answered):
    """Have an iteration whose value comes `late` s after its beginning, far behind a question for it."""
    one.handle_timer(now + 0.2)
    if answered:
        one.receive("r1", THEIRS, step_of(k - 1), now + 0.25)
    one.receive("r1", THEIRS, step_of(k), now + late)
    one.computed(b"a%d" % (k + 1), b"", now + late)
    return now + late


def test_values_of_a_robot_that_answers_that_it_has_none_yet_are_late_and_asked_for_later():
    now, one = 0.0, at(1)
    for k in range(1, 5):
        now = gone_through(one, now, k, 0.45, answered=True)
    assert one.next_deadline() - now == pytest.approx(0.9)
    for k in range(5, 8):
        now = gone_through(one, now, k, 0.8, answered=True)
    assert one.next_deadline() - now == pytest.approx(1.0)  # a second at most where round trips are short
    one.rtt = 0.15
    now = gone_through(one, now, 8, 0.8, answered=True)
    assert one.next_deadline() - now == pytest.approx(1.5)


def test_values_of_a_robot_that_does_not_answer_may_have_been_lost_and_are_asked_for_as_soon_as_before():
    now, one = 0.0, at(1)
    for k in range(1, 5):
        now = gone_through(one, now, k, 0.45, answered=False)
    assert one.next_deadline() - now == pytest.approx(0.2)


def test_neighbours_that_are_yet_to_start_are_given_longer():
    assert started(rtt=0.001).next_deadline() == pytest.approx(1.0)
    slow = started(rtt=0.5)
    assert slow.next_deadline() == pytest.approx(1.5)
    slow.handle_timer(1.5)
    slow.handle_timer(3.0)
    assert slow._questions.due == pytest.approx(4.5)


@pytest.mark.parametrize("k", [1, 2])
def test_want_for_the_last_two_iterations_is_answered_to_the_asker_alone(k):
    one = at(2, ("r1", "r2"))
    one.receive("r1", THEIRS, encode_want(k), 1.0)
    assert one.actions() == [Send(encode_step(2, b"a2", b"a1"), "r1")]


def test_want_for_what_is_not_computed_yet_is_answered_since_the_link_carries():
    one = at(2)
    one.receive("r1", THEIRS, encode_want(3), 1.0)
    assert one.actions() == [Send(encode_step(2, b"a2", b"a1"), "r1")]


def test_want_is_answered_once_a_round_trip():
    one = at(2, ("r1", "r2"))
    for peer, k, now in (("r1", 2, 1.0), ("r1", 2, 1.05), ("r1", 1, 1.05), ("r2", 2, 1.05), ("r1", 1, 1.2)):
        one.receive(peer, THEIRS, encode_want(k), now)
    assert [action.to for action in one.actions()] == ["r1", "r1", "r2", "r1"]
    assert one.counters["want suppressed"] == 1


def test_data_never_triggers_data():
    one = at(2)
    for k in (1, 0, 1, 2, 2):
        one.receive("r1", THEIRS, step_of(k), 1.0)
    assert kinds(one.actions()) == [Compute]
    assert one.counters == {"duplicate": 3, "late": 1}


def test_link_up_moves_the_question_to_now_and_nothing_else():
    one = started(("r1", "r2"))
    one.nudge(0.08)
    assert one.actions() == []
    assert one.next_deadline() == 0.08
    one.handle_timer(0.08)
    assert len(wants(one.actions())) == 4
    one.nudge(0.09)  # six links that come up together are one reason to ask
    assert one.next_deadline() == pytest.approx(0.14)
    one.receive("r1", THEIRS, step_of(0), 0.1)
    one.receive("r2", THEIRS, step_of(0), 0.1)
    one.nudge(0.11)
    assert one.next_deadline() is None


def test_link_up_asks_for_nothing_that_may_be_on_its_way():
    """A host hears first of a link that has been up all the time, in the middle of an iteration."""
    one = at(2)
    one.nudge(0.01)
    assert one.next_deadline() == pytest.approx(0.06)
    one.receive("r1", THEIRS, step_of(2), 0.05)
    assert one.next_deadline() is None


# Waiting


def test_robots_waited_for_are_named_within_three_seconds():
    one = at(1, ("r1", "r2", "r3"))
    one.receive("r2", THEIRS, step_of(1), 0.1)
    said = []
    while one.next_deadline() < 3.0:
        now = one.next_deadline()
        one.handle_timer(now)
        said += [action for action in one.actions() if isinstance(action, Waiting)]
    assert said == [Waiting(1, ("r1", "r3"))]
    assert one.waiting_for == ("r1", "r3")
    one.receive("r3", THEIRS, step_of(1), 4.0)
    assert one.actions() == [Waiting(1, ("r1",))]
    one.receive("r1", THEIRS, step_of(1), 5.0)
    assert [type(action) for action in one.actions()] == [Waiting, Compute]
    assert one.waiting_for == ()


def test_the_end_of_a_wait_is_said():
    one = at(1)
    one.handle_timer(2.6)
    assert one.actions()[-1] == Waiting(1, ("r1",))
    one.receive("r1", THEIRS, step_of(1), 2.7)
    assert one.actions()[0] == Waiting(1, ())


def test_an_own_slow_step_names_nobody():
    one = started()
    one.receive("r1", THEIRS, step_of(0), 0.0)
    one.actions()
    one.handle_timer(10.0)
    assert one.actions() == []


# The last iteration


def test_a_robot_at_the_last_iteration_stays_until_all_are_there():
    one = at(3, ("r1", "r2"), last=3)
    assert not one.done
    one.receive("r1", THEIRS, encode_want(2), 1.0)  # it lost x(2)
    assert kinds(one.actions()) == [Send]
    one.receive("r1", THEIRS, step_of(3), 1.1)
    one.receive("r2", THEIRS, encode_want(3), 1.2)
    assert one.done
    assert [action.to for action in one.actions()] == ["r2"]
    assert one.next_deadline() is None


def test_a_finished_lockstep_leaves_after_a_time_out():
    one = at(3, ("r1", "r2"), last=3, linger=4.0)
    while not one.done:
        now = one.next_deadline()
        one.handle_timer(now)
        assert not any(isinstance(action, Waiting) for action in one.actions())  # nothing waits any more
    assert now == 4.0


def test_nothing_is_left_to_do_where_zero_is_the_last():
    one = core(last=0)
    one.start(b"a0", 0.0)
    assert kinds(one.actions()) == [Save, Send, Advanced, Finished]
    one.receive("r1", THEIRS, step_of(0), 0.0)
    assert one.done


def test_a_robot_restarted_at_its_last_iteration_is_finished_at_once():
    again, _ = resumed(last_save(started(last=3), 3), last=3)
    assert Finished(3) in again.actions()
    again.receive("r1", THEIRS, step_of(3), 100.0)
    assert again.done
