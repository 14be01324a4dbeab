"""Lockstep in whole swarms: the nine holes of the naive protocol (docs/reference/network/lockstep.md), a test each."""

import dataclasses
from collections import Counter

import pytest
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st
from lockstep_core import THEIRS, at, step_of, wants
from lockstep_world import EDGES, RUN, STATE, World, named

from swarm.core.lockstep import lockstep
from swarm.core.lockstep.actions import Compute
from swarm.core.lockstep.frames import (
    STEP,
    WANT,
    encode_step,
    encode_want,
)

SHAPES = [("line", 2), ("line", 6), ("loop", 6), ("full", 6)]


@pytest.mark.parametrize(("shape", "n"), SHAPES)
@pytest.mark.parametrize("jitter", [0.0, 0.02])
def test_without_loss_there_is_one_message_per_neighbour_and_iteration(shape, n, jitter):
    world = World(named(EDGES[shape](n)), 30, jitter=jitter, linger=10.0)
    world.start_all()
    assert world.run(30 * (world.latency + jitter) + 1e-6, until=world.finished)
    world.run(1.0)
    assert world.sent == {(a, b, STEP): 31 for a in world.neighbours for b in world.neighbours[a]}
    assert all(process.core.done for process in world.running())
    assert world.faults == []


@pytest.mark.parametrize(("shape", "n"), SHAPES)
def test_an_iteration_takes_one_latency(shape, n):
    world = World(named(EDGES[shape](n)), 40)
    world.start_all()
    assert world.run(60.0, until=world.finished)
    assert world.now == pytest.approx(40 * world.latency)


def messages(world):
    return sum(world.sent.values())


def test_hole_1_resends_of_others_do_not_keep_a_robot_from_asking():
    """A start on the full graph with losses took 12 s with a timer that any traffic winds, once for ever."""
    world = World(named(EDGES["full"](6)), 1, seed=4)
    world.loss = 0.35
    world.start_all()
    assert not world.run(0.3, until=world.finished)
    world.loss = 0.0
    assert world.run(1.0, until=world.finished)
    # And one by one: r0 has all but r5; another one keeps talking to it.
    one = at(1, ("r1", "r5"))
    for i in range(25):
        one.receive("r1", THEIRS, step_of(1), i / 100)
    one.actions()
    one.handle_timer(0.25)
    assert wants(one.actions())[-1] == ("r5", encode_want(1))


def test_hole_2_no_storm_of_old_values():
    """Both sides a little apart, both frames come again: nothing comes of it."""
    world = World([("r0", "r1")], 50)
    world.copies = 1.0
    world.start_all()
    assert world.run(60.0, until=world.finished)
    world.run(5.0)
    assert messages(world) == 2 * 51


def test_hole_3_both_values_are_in_one_message():
    one = at(1)
    one.receive("r1", THEIRS, step_of(2), 0.0)  # the frame of iteration 1 was lost
    assert one.actions() == [Compute(1, b"a1", {"r1": b"b1"})]
    one.computed(b"a2", b"", 0.0)
    assert one.actions()[-1] == Compute(2, b"a2", {"r1": b"b2"})


@pytest.mark.parametrize("actions", range(8))
def test_hole_4_a_killed_app_goes_on_with_its_private_state(actions):
    """Killed after every single action in turn; the world compares each value with the undisturbed run."""
    world = World(named(EDGES["line"](3)), 30)
    world.compute = 0.004
    world.start_all()
    world.run(0.3)
    world.one("r1").dies_after = actions
    world.run(0.5)
    assert world.processes["r1"] == []
    world.start("r1")
    assert world.run(3.0, until=world.finished)


def test_hole_5_a_previous_run_and_a_second_process():
    world = World(named(EDGES["line"](3)), 100)
    world.start_all()
    world.run(0.3)
    victim = world.one("r1")
    ghost = dataclasses.replace(world.one("r0").channel, run=RUN - 1, incarnation=9)
    for k in (victim.core.k, victim.core.k + 1):
        victim.receive("r0", ghost.text, encode_step(k, STATE.pack(-1.0), STATE.pack(-2.0)))
    assert victim.core.counters["other run"] == 2

    told = []
    world.on_fault = lambda process, reason: told.append((process.incarnation, reason))
    world.start("r1")
    assert world.run(6.0, until=world.finished)
    assert told == [(0, "another process runs this app on r1 (incarnation 1, this one is 0)")]
    assert world.one("r0").core.counters["old incarnation"] >= 0


def test_hole_6_a_robot_at_the_end_does_not_strand_its_neighbour():
    world = World([("r0", "r1")], 10, linger=10.0)
    world.leave_when_done = True
    world.start_all()
    world.run(9 * world.latency + 0.001)  # x(9) of both is on its way
    world.cut_link(("r0", "r1"))
    world.one("r0").receive(
        "r1", world.one("r1").channel.text, encode_step(9, world.truth["r1"][9], world.truth["r1"][8])
    )
    assert world.reached == {"r0": 10, "r1": 9}
    world.run(5.0)
    assert world.processes["r0"], "gone while its neighbour lacks x(9)"
    world.mend_link(("r0", "r1"))
    assert world.run(1.0, until=world.finished)
    world.run(0.2)
    assert world.running() == []


def test_hole_7_members_are_fixed_and_other_epochs_are_not_heard():
    """The policy is to wait: nobody is dropped, so no two epochs can come about."""
    world = World(named(EDGES["line"](3)), 50)
    world.start_all()
    world.run(0.3)
    world.kill("r2")
    world.run(600.0)
    assert {process.core.channel.epoch for process in world.running()} == {0}
    assert world.one("r1").waits[-1][2] == ("r2",)
    r1 = world.one("r1")
    wrong = encode_step(r1.core.k, STATE.pack(-1.0), STATE.pack(-1.0))
    r1.receive("r2", dataclasses.replace(r1.channel, epoch=1, incarnation=9).text, wrong)
    assert r1.core.counters["other epoch"] == 1
    world.start("r2")
    assert world.run(3.0, until=world.finished)


def test_hole_8_no_link_up_is_needed():
    world = World([("r0", "r1")], 60)
    world.start_all()
    world.run(0.5)
    world.cut_link(("r0", "r1"))
    world.run(20.0)
    world.cut.clear()  # the link is back and nobody was told
    assert world.run(1.0 + 60 * world.latency, until=world.finished)


def test_hole_9_sums_do_not_depend_on_the_order_of_arrival():
    """The world's step shows any other order in its last bits, and every value is compared."""
    for seed in range(5):
        world = World(named(EDGES["full"](5)), 20, seed=seed, jitter=0.05)
        world.start_all()
        assert world.run(10.0, until=world.finished)


def test_no_want_storm_on_the_full_graph():
    """Six robots all joined, 4.8 % of the messages lost on each bus: few messages more than without loss."""
    world = World(named(EDGES["full"](6)), 200, seed=1)
    world.loss = 0.048
    world.start_all()
    assert world.run(200.0, until=world.finished)
    needed = 30 * 201
    counters = sum((process.core.counters for process in world.running()), Counter())
    asked = counters["want sent"] + counters["links gone around"]
    # Each question brings its own frame and at most one answer, and a frame alone never brings one. Where a question
    # or its answer was lost, too, the same goes around the link.
    assert messages(world) <= needed + 3 * asked
    assert counters["want answered"] <= asked
    assert messages(world) < 1.5 * needed


def test_no_want_storm_where_links_are_out_one_twentieth_of_the_time():
    world = World(named(EDGES["full"](6)), 400, seed=2)
    world.start_all()
    for i in range(400):
        edge = world.edges[i % 15]
        world.at(i * 0.18, lambda edge=edge: world.cut_link(edge))
        world.at(i * 0.18 + 0.13, lambda edge=edge: world.mend_link(edge))  # each link is out 0.13 of 2.7 s
    assert world.run(90.0, until=world.finished)
    assert messages(world) < 1.25 * 30 * 401


def test_a_robot_that_lost_its_snapshot_is_named():
    world = World(named(EDGES["line"](4)), 100)
    told = {}
    world.on_fault = lambda process, reason: told.setdefault(process.robot, reason)
    world.start_all()
    world.run(1.0)
    world.kill("r1")
    del world.disk["r1"]
    world.start("r1")
    world.run(3.0)
    assert set(told) == {"r0", "r1", "r2"}  # itself and its neighbours
    assert all(reason.startswith("state lost at r1:") for reason in told.values())
    assert world.one("r3").waits[-1][2] == ("r2",)
    assert world.one("r1").core.k == 0


@pytest.mark.parametrize("before", [1, 4])
def test_a_robot_that_lost_snapshot_and_incarnation_finds_out_itself(before):
    """Its first frames look like late copies; the answer to its question tells it."""
    world = World(named(EDGES["line"](3)), 100)
    told = {}
    world.on_fault = lambda process, reason: told.setdefault(process.robot, reason)
    world.start_all()
    for _ in range(before - 1):
        world.run(0.1)
        world.kill("r1")
        world.start("r1")
    world.run(1.0)
    world.kill("r1")
    del world.disk["r1"]
    world.incarnations["r1"] = 0
    world.start("r1")
    world.run(3.0)
    assert told["r1"].startswith("state lost at r1:")
    assert world.one("r0").waits[-1][2] == ("r1",)


def test_a_stopped_robot_is_named_and_the_run_goes_on():
    world = World(named(EDGES["line"](3)), 100)
    world.start_all()
    world.run(1.0)
    world.one("r2").stopped = True
    stopped = world.now
    world.run(5.0)
    (when, _, peers) = world.one("r1").waits[-1]
    assert peers == ("r2",)
    assert when - stopped < 3.0
    assert world.one("r0").waits[-1][2] == ("r1",)
    world.one("r2").go_on()
    assert world.run(6.0, until=world.finished)
    assert world.one("r1").waits[-1][2] == ()


def test_a_second_process_that_nobody_hears_of_does_not_fork_anything():
    """The fence of last resort is gone too (the bus loses the own frames): values stay equal, or a fault is named."""
    world = World(named(EDGES["loop"](3)), 60)
    world.hears_itself = False
    world.on_fault = lambda process, reason: None
    world.start_all()
    world.run(0.5)
    world.start("r1")
    assert world.run(6.0, until=world.finished)


@costly(60)
@given(
    shape=st.sampled_from(sorted(EDGES)),
    n=st.integers(3, 6),
    loss=st.floats(0.0, 0.6),
    copies=st.floats(0.0, 1.0),
    seed=st.integers(0, 1000),
)
def test_every_lossy_swarm_comes_to_its_end(shape, n, loss, copies, seed):
    world = World(named(EDGES[shape](n)), 5, seed=seed, jitter=0.02)
    world.loss, world.copies = loss, copies
    world.start_all()
    assert world.run(600.0, until=world.finished)


def test_the_promise_of_three_seconds_leaves_time_for_the_bus():
    assert lockstep.NAME_AFTER <= 2.5
    assert WANT != STEP
