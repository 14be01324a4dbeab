"""Changes of a run's members, robot by robot and case by case; the state machine is in test_epochs_machine."""

import pytest
from epochs_world import World, full, line, loop

from swarm.core.epochs.actions import EpochRequest
from swarm.core.lockstep.stopping import Rule


def counters(world):
    return {name: process.lockstep.epochs.epoch.counter for name, process in world.processes.items()}


def running(edges, **options):
    world = World(edges, **options)
    world.start_all()
    world.run(1.0)
    assert all(process.lockstep.k > 5 for process in world.processes.values())
    return world


def test_nobody_says_anything_about_members_while_all_is_well():
    world = running(loop(4))
    assert set(counters(world).values()) == {0}
    assert all(process.lockstep.epochs._mine.version == 0 for process in world.processes.values())


def test_a_robot_that_dies_is_dropped_and_taken_in_again_with_its_state():
    world = running(loop(5))
    world.kill("r2")
    assert world.run(6.0, until=lambda: set(counters(world).values()) == {1})
    epoch = world.processes["r0"].lockstep.epochs.epoch
    assert epoch.members == epoch.carried == ("r0", "r1", "r3", "r4")
    assert world.run(5.0, until=lambda: all(p.lockstep.k > epoch.k + 10 for p in world.processes.values()))
    world.start("r2")
    assert world.run(5.0, until=world.together)
    assert "r2" not in world.processes["r0"].lockstep.epochs.epoch.carried
    assert world.moving()
    version = world.processes["r0"].lockstep.epochs._mine.version
    world.run(10.0)
    assert world.processes["r0"].lockstep.epochs._mine.version == version


def test_a_robot_that_reboots_comes_back_in_a_new_epoch():
    world = running(loop(4))
    world.reboot("r1")
    world.start("r1")
    assert world.run(6.0, until=lambda: world.together() and set(counters(world).values()) == {1})
    assert world.processes["r0"].lockstep.epochs.epoch.carried == ("r0", "r2", "r3")
    assert world.moving()


def test_where_robots_are_waited_for_one_that_reboots_waits_for_the_operator():
    world = running(loop(4), drop=False)
    world.reboot("r1")
    world.start("r1")
    world.run(10.0)
    assert set(counters(world).values()) == {0}
    assert world.processes["r1"].lockstep.obstacle == "r1 has lost its state and waits for the next epoch"
    world.processes["r3"].take(lambda p: p.lockstep.request(EpochRequest(), world.now))
    assert world.run(6.0, until=lambda: world.together() and set(counters(world).values()) == {1})
    assert world.moving()


def test_the_whole_swarm_reboots_and_begins_anew():
    world = running(line(3))
    for name in world.names:
        world.reboot(name)
    world.start_all()
    assert world.run(10.0, until=lambda: world.together() and 0 not in counters(world).values())
    assert world.moving()


def test_a_minority_never_goes_on():
    world = running(line(5))
    world.cut.add(("r1", "r2"))
    assert world.run(8.0, until=lambda: counters(world)["r3"] == 1)
    world.run(10.0)
    assert counters(world) == {"r0": 0, "r1": 0, "r2": 1, "r3": 1, "r4": 1}
    lockstep = world.processes["r0"].lockstep
    assert lockstep.obstacle == "the members change: 2 of 5 have answered, more than half are needed"
    world.cut.clear()
    assert world.run(8.0, until=world.together)
    assert world.moving()


def test_two_equal_halves_wait_for_each_other_or_for_the_operator():
    world = running(line(4))
    world.cut.add(("r1", "r2"))
    world.run(10.0)
    assert set(counters(world).values()) == {0}
    world.processes["r0"].take(lambda p: p.lockstep.request(EpochRequest(force=True), world.now))
    assert world.run(5.0, until=lambda: counters(world) == {"r0": 1, "r1": 1, "r2": 0, "r3": 0})
    assert world.processes["r0"].lockstep.epochs.epoch.forced
    world.run(3.0)
    assert world.processes["r0"].lockstep.k > world.processes["r3"].lockstep.k
    world.cut.clear()
    assert world.run(10.0, until=world.together)
    assert world.moving()


def test_policy_wait_waits_until_the_operator_says_so():
    world = running(loop(4), drop=False)
    world.kill("r3")
    world.run(10.0)
    assert set(counters(world).values()) == {0}
    world.processes["r1"].take(lambda p: p.lockstep.request(EpochRequest(drop=("r3",)), world.now))
    assert world.run(3.0, until=lambda: set(counters(world).values()) == {1})
    world.start("r3")
    world.run(10.0)
    assert counters(world)["r3"] == 1
    assert world.processes["r3"].lockstep.obstacle == "r3 is not in epoch 1: only the operator lets it in again"
    world.processes["r1"].take(lambda p: p.lockstep.request(EpochRequest(add=("r3",)), world.now))
    assert world.run(3.0, until=world.together)
    assert world.moving()


def test_the_operator_sends_a_robot_away_that_is_well():
    world = running(full(4))
    world.processes["r0"].take(lambda p: p.lockstep.request(EpochRequest(drop=("r2",)), world.now))
    assert world.run(3.0, until=lambda: set(counters(world).values()) == {1})
    world.run(10.0)
    assert set(counters(world).values()) == {1}
    assert world.processes["r0"].lockstep.epochs.epoch.members == ("r0", "r1", "r3")


def test_a_link_that_stays_cut_is_gone_around():
    world = running(loop(4))
    world.cut.add(("r0", "r1"))
    for _ in range(5):
        assert world.moving()
    world.run(10.0)
    assert set(counters(world).values()) == {0}


def test_a_link_that_stays_cut_and_cannot_be_gone_around_is_left_out():
    world = running(loop(4))
    world.goes_around = False
    world.cut.add(("r0", "r1"))
    assert world.run(8.0, until=lambda: set(counters(world).values()) == {1})
    assert world.processes["r0"].lockstep.epochs.epoch.edges == (("r0", "r3"), ("r1", "r2"), ("r2", "r3"))
    assert world.moving()


def test_a_run_is_carried_over_to_other_links():
    world = running(full(4))
    odd = (*loop(4), ("r1", "r0"), ("r2", "r2"), ("r9", "r0"))  # a topology that no mesh of ours tells
    for process in list(world.processes.values()):
        process.take(lambda p: p.lockstep.epochs.take_links(odd))
    assert world.run(5.0, until=lambda: set(counters(world).values()) == {1})
    assert len(world.processes["r0"].lockstep.epochs.epoch.edges) == 4
    assert world.moving()


def test_an_app_in_fault_is_dropped_and_the_others_go_on():
    world = running(loop(4))
    world.processes["r2"].take(lambda p: p.lockstep.fail("it raises", world.now))
    assert world.run(3.0, until=lambda: set(counters(world).values()) == {1})
    assert world.processes["r0"].lockstep.epochs.epoch.members == ("r0", "r1", "r3")
    before = world.processes["r0"].lockstep.k
    assert world.run(3.0, until=lambda: world.processes["r0"].lockstep.k > before + 5)


def test_robots_that_come_late_to_a_run_that_has_begun_without_them():
    world = World(full(5))
    for name in ("r0", "r1", "r2"):
        world.start(name)
    assert world.run(8.0, until=lambda: set(counters(world).values()) == {1})
    world.start("r3")
    world.run(1.0)
    world.start("r4")
    assert world.run(8.0, until=world.together)
    assert world.moving()


def test_a_robot_that_still_restores_its_state_answers_no_ballot_before_it_knows_where_it_is():
    world = running(line(2), drop=False)
    world.kill("r1")
    k = world.processes["r0"].lockstep.k
    world.starting = 3.0
    world.start("r1")
    world.processes["r0"].take(lambda p: p.lockstep.request(EpochRequest(), world.now))
    world.run(2.5)
    assert counters(world) == {"r0": 0, "r1": 0}
    assert world.run(6.0, until=lambda: world.together() and set(counters(world).values()) == {1})
    assert world.processes["r0"].lockstep.epochs.epoch.k >= k - 1
    assert world.moving()


def test_a_robot_without_a_state_answers_no_ballot_as_if_it_had_one():
    world = running(line(2), drop=False)
    world.reboot("r1")
    k = world.processes["r0"].lockstep.k
    world.starting = 3.0
    world.start("r1")
    world.processes["r0"].take(lambda p: p.lockstep.request(EpochRequest(), world.now))
    assert world.run(9.0, until=lambda: world.together() and set(counters(world).values()) == {1})
    epoch = world.processes["r0"].lockstep.epochs.epoch
    assert (epoch.carried, epoch.k) == (("r0",), k)
    assert world.moving()


@pytest.mark.parametrize("comes", ["resumes", "reboots", "is new", "has lost its vote"])
def test_an_epoch_that_is_decided_while_a_robot_starts_begins_once(comes):
    world = running(full(3)) if comes != "is new" else World(full(3))
    if comes == "is new":
        world.start("r0")
        world.start("r1")
        world.run(1.0)
    elif comes == "reboots":
        world.reboot("r2")
    elif comes == "has lost its vote":
        world.damage("r2")
    else:
        world.kill("r2")
    world.starting = 3.0
    world.start("r2")
    world.processes["r0"].take(lambda p: p.lockstep.request(EpochRequest(), world.now))
    assert world.run(2.9, until=lambda: all(counter >= 1 for counter in counters(world).values()))
    assert not world.processes["r2"].lockstep.begun
    assert world.run(9.0, until=world.together)
    assert world.moving()
    assert world.processes["r2"].renewed  # each of them once: the world sees to that


# -- stop rules --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("edges", [line(2), line(5), loop(6), full(4)])
def test_all_stop_at_the_same_iteration_when_all_are_content(edges):
    world = World(edges, rule=Rule(rounds=4), content=lambda x: x > 1.0, drop=False)
    world.start_all()
    assert world.run(60.0, until=lambda: all(p.finished is not None for p in world.processes.values()))
    assert len({p.finished for p in world.processes.values()}) == 1


def test_all_stop_at_the_same_iteration_when_the_time_of_the_first_is_up():
    world = World(loop(5), rule=Rule(seconds=3.0), drop=False)
    world.start("r3")
    world.run(1.0)
    world.start_all()
    assert world.run(10.0, until=lambda: all(p.finished is not None for p in world.processes.values()))
    assert len({p.finished for p in world.processes.values()}) == 1
    assert 2.5 < world.now < 4.0


def test_a_killed_robot_remembers_that_it_has_stopped():
    world = World(line(3), rule=Rule(seconds=1.0), drop=False)
    world.start_all()
    world.run(10.0)
    k = world.processes["r1"].finished
    world.kill("r1")
    world.start("r1")
    world.run(1.0)
    assert world.processes["r1"].finished == k is not None
    assert world.processes["r1"].lockstep.phase == "done"


def damaged(world, robot, *, reboots=False):
    """Have a robot come back without its votes, after a reboot without all else, too."""
    world.damage(robot)
    if reboots:
        world.reboot(robot)
        world.births[robot] = 0
    world.start(robot)


def test_a_robot_whose_votes_are_damaged_goes_on_and_votes_again_from_the_next_epoch_on():
    world = running(loop(4))
    damaged(world, "r1")
    process = world.processes["r1"]
    assert process.lockstep.epochs.lost
    assert process.lockstep.begun  # its snapshots are of the epoch that it knows
    assert world.run(6.0, until=lambda: world.together() and set(counters(world).values()) == {1})
    assert not process.lockstep.epochs.lost
    epoch = process.lockstep.epochs.epoch
    assert len(epoch.restored) == 1
    assert epoch.carried == ("r0", "r2", "r3")
    assert world.moving()
    world.kill("r3")
    assert world.run(8.0, until=lambda: counters(world) == {"r0": 2, "r1": 2, "r2": 2})
    assert world.processes["r1"].lockstep.epochs.epoch.restored == ()


def test_a_robot_that_reboots_and_finds_its_votes_damaged_does_not_begin_the_epoch_anew():
    world = running(loop(4))
    damaged(world, "r1", reboots=True)
    lockstep = world.processes["r1"].lockstep
    assert not lockstep.begun
    assert lockstep.obstacle == "r1 has lost its state and waits for the next epoch"
    assert world.run(6.0, until=lambda: world.together() and set(counters(world).values()) == {1})
    assert world.moving()


def test_a_robot_without_its_votes_does_not_answer_a_ballot_that_it_may_have_answered():
    """r1 votes with r0 for an epoch without r2, and loses that vote. r2 and r1 must not make another one."""
    world = running(full(3), drop=False)
    world.cut |= {("r0", "r2"), ("r1", "r2")}
    world.processes["r0"].take(lambda p: p.lockstep.request(EpochRequest(drop=("r2",)), world.now))
    assert world.run(5.0, until=lambda: counters(world)["r0"] == 1)
    world.kill("r0")
    damaged(world, "r1", reboots=True)
    world.cut.clear()
    world.cut |= {("r0", "r1"), ("r0", "r2")}
    world.processes["r2"].take(lambda p: p.lockstep.request(EpochRequest(drop=("r0",)), world.now))
    world.run(10.0)
    assert counters(world) == {"r1": 0, "r2": 0}
    world.cut.clear()
    world.start("r0")
    assert world.run(10.0, until=lambda: all(counter >= 1 for counter in counters(world).values()))


def test_a_robot_without_its_votes_enters_no_epoch_that_it_may_have_been_in():
    """What it sent in that epoch it does not know any more, so it waits for the one after it."""
    world = running(full(4), drop=False)
    world.kill("r3")
    world.processes["r0"].take(lambda p: p.lockstep.request(EpochRequest(drop=("r3",)), world.now))
    assert world.run(5.0, until=lambda: counters(world) == {"r0": 1, "r1": 1, "r2": 1})
    world.run(2.0)
    damaged(world, "r1", reboots=True)
    world.run(10.0)
    lockstep = world.processes["r1"].lockstep
    assert counters(world)["r1"] == 1
    assert not lockstep.begun
    world.processes["r0"].take(lambda p: p.lockstep.request(EpochRequest(), world.now))
    assert world.run(6.0, until=lambda: counters(world) == {"r0": 2, "r1": 2, "r2": 2})
    assert not lockstep.epochs.lost
    assert world.moving_of("r0", "r1", "r2")


def test_where_too_few_have_their_votes_the_operator_goes_on():
    world = running(line(2))
    damaged(world, "r1")
    world.run(10.0)
    assert set(counters(world).values()) == {0}
    assert world.moving()  # nobody stops for an election that cannot be won
    world.processes["r0"].take(lambda p: p.lockstep.request(EpochRequest(force=True), world.now))
    assert world.run(6.0, until=lambda: set(counters(world).values()) == {1})
    assert not world.processes["r1"].lockstep.epochs.lost
    assert world.moving()


def test_a_lost_vote_stays_lost_through_further_restarts():
    world = running(loop(4), drop=False)
    damaged(world, "r1")
    world.run(2.0)
    number = world.processes["r1"].lockstep.epochs.kept.note.lost
    world.kill("r1")
    world.start("r1")
    assert world.processes["r1"].lockstep.epochs.kept.note.lost == number != 0
