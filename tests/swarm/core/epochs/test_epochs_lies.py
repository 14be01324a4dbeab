"""Notes about the members of a run that nobody could have meant: no number and no name in them ends a robot's part."""

import dataclasses

import pytest
from conftest import costly
from epochs_world import World as EpochsWorld
from hypothesis import given
from hypothesis import strategies as st

from swarm.core.epochs.actions import SaveEpochs, SendToNeighbours
from swarm.core.epochs.choice import decided
from swarm.core.epochs.epochs import MAX_FOUND, Epochs
from swarm.core.epochs.notes import (
    LOST,
    MAX_EPOCH,
    NONE,
    Ballot,
    Epoch,
    EpochNote,
    Offer,
    SavedEpochs,
    Vote,
    first,
    following,
)
from swarm.core.lockstep.frames import MAX_ITERATION
from swarm.errors import PayloadError
from swarm.messages.codec import MAX_COUNT, decode, encode

LINE = (("r0", "r1"), ("r1", "r2"))
NAMES = ("r0", "r1", "r2")
BEGIN = first(NAMES, LINE, 0)
OF = (0xA1, 0x9F3C21AA)


def note(robot: str = "r2", **fields: object) -> EpochNote:
    known = EpochNote(robot, 1, 1, BEGIN, 3, True, (), NONE, None, None, 0)
    return dataclasses.replace(known, **fields)  # type: ignore[arg-type]


def epochs_of(robot: str = "r0", kept: SavedEpochs | None = None) -> Epochs:
    return Epochs(robot, NAMES, OF, 5, BEGIN, kept, auto=True)


def told(epochs: Epochs) -> list[EpochNote]:
    """What a robot tells the others, decoded as they decode it; what it keeps comes back from its file."""
    actions = epochs.actions()
    for action in actions:
        if isinstance(action, SaveEpochs):
            assert decode(SavedEpochs, encode(action.kept), "") == action.kept
    return [EpochNote.decode(action.data) for action in actions if isinstance(action, SendToNeighbours)]


class World(EpochsWorld):
    """A run in which a robot lies: which epochs there are and what comes of them is no longer what its model says."""

    def decided(self, epoch: Epoch) -> None:
        self.epochs[epoch.number] = epoch

    def on_fault(self, process: object, reason: str) -> None:
        assert "fault of" not in reason

    def reached(self, robot: str, number: int, k: int, state: object) -> None:
        self.progress[robot] = (number, k)

    def enters(self, robot: str, number: int, state: object) -> None:
        pass


def test_a_robot_whose_count_of_starts_was_forged_to_the_greatest_number_goes_on() -> None:
    """It could not pack the next one, and stopped for good with a fault."""
    world = EpochsWorld(LINE)
    world.start_all()
    world.run(1.0)
    forged = dataclasses.replace(note("r1"), birth=MAX_COUNT)
    for robot in NAMES:
        world.processes[robot].take(lambda other: other.lockstep.receive_note("r0", forged.encode(), world.now))
    before = world.progress["r1"]
    world.run(5.0)
    assert world.progress["r1"] > before
    assert all(process.lockstep.phase == "running" for process in world.processes.values())
    assert world.processes["r1"].lockstep.counters["impossible birth"] >= 1


@pytest.mark.parametrize("liar", NAMES)
def test_a_vote_for_another_epoch_in_the_same_ballot_counts_for_that_epoch_alone(liar: str) -> None:
    """As of two robots with one name, or of a member that lies: the majority has decided what it has voted for."""
    ballot = Ballot(1, "r1")
    agreed, other = (following(BEGIN, "r1", k, NAMES, NAMES, LINE, (), (), forced=False) for k in (3, 7))
    votes = {name: Vote(ballot, other if name == liar else agreed) for name in NAMES}
    assert decided(BEGIN, {name: note(name, promised=ballot, accepted=vote) for name, vote in votes.items()}) == agreed


@pytest.mark.parametrize("birth", [MAX_COUNT + 1, (1 << 64) - 1, -1])
def test_a_count_of_starts_out_of_range_is_no_note(birth: int) -> None:
    epochs = epochs_of("r1")
    epochs.receive(encode(note("r1", birth=birth)), 0.0)
    assert epochs.counters["malformed note"] == 1
    assert epochs.birth == 5


def test_a_robot_goes_on_from_a_greater_count_of_starts_that_others_know() -> None:
    epochs = epochs_of("r1")
    epochs.receive(note("r1", birth=MAX_FOUND - 1).encode(), 0.0)
    assert epochs.birth == MAX_FOUND
    assert told(epochs)[-1].birth == MAX_FOUND
    again = Epochs("r1", NAMES, OF, 1, BEGIN, epochs.kept, auto=True)
    assert again.birth == MAX_FOUND + 1


def test_a_round_at_the_greatest_number_is_not_gone_beyond() -> None:
    epochs = epochs_of("r0")
    epochs.receive(note("r2", promised=Ballot(MAX_COUNT, "r2")).encode(), 0.0)
    epochs.withdraw(0.1)
    epochs.well = True
    epochs.suspect(("r1",), 0.2)
    for tenth in range(100):
        epochs.handle_timer(tenth / 10)
    assert all(each.promised.round <= MAX_COUNT for each in told(epochs))


def test_an_epoch_at_the_greatest_count_has_no_successor_and_breaks_nothing() -> None:
    last = following(
        dataclasses.replace(BEGIN, counter=MAX_COUNT - 1), "r2", 7, NAMES, NAMES, LINE, (), (), forced=False
    )
    epochs = epochs_of("r0")
    epochs.receive(note("r2", epoch=last).encode(), 0.0)
    assert epochs.epoch == last
    epochs.settle()
    epochs.k = 7
    epochs.suspect(("r1",), 0.1)
    for tenth in range(100):
        now = tenth / 10
        epochs.receive(note("r2", epoch=last, version=tenth + 2, promised=epochs._mine.promised).encode(), now)
        epochs.handle_timer(now)
    assert epochs.epoch == last
    assert told(epochs)


def test_an_epoch_of_robots_that_are_in_no_configuration_is_refused() -> None:
    names = ("r0", "r1", "stranger")
    forged = following(BEGIN, "r2", 7, names, (), (("r0", "r1"), ("r1", "stranger")), (), (), forced=True)
    epochs = epochs_of("r0")
    epochs.receive(note("r2", epoch=forged).encode(), 0.0)
    epochs.receive(note("r2", offer=Offer(Ballot(1, "r2"), forged, forced=True)).encode(), 0.0)
    assert epochs.counters["unknown robot"] == 2
    assert epochs.epoch == BEGIN


def test_an_epoch_too_long_for_a_note_with_three_of_them_is_refused() -> None:
    names = tuple(sorted(f"robot-number{n:03}" for n in range(250)))
    edges = tuple((a, b) for at, a in enumerate(names) for b in names[at + 1 : at + 8])
    forged = following(BEGIN, "r2", 7, names, names, edges, (), (), forced=True)
    assert len(encode(forged)) > MAX_EPOCH
    with pytest.raises(PayloadError, match="contradicts itself"):
        EpochNote.decode(note("r2", epoch=forged).encode())


def test_an_epoch_that_begins_behind_the_last_iteration_ends_the_run() -> None:
    world = World(LINE, last=50)
    world.start_all()
    world.run(1.0)
    late = following(BEGIN, "r2", MAX_ITERATION, NAMES, (), LINE, (), (), forced=True)
    forged = note("r2", epoch=late, birth=9)
    for robot in NAMES:
        world.processes[robot].take(lambda other: other.lockstep.receive_note("r2", forged.encode(), world.now))
    world.run(5.0)
    assert {process.lockstep.phase for process in world.processes.values()} == {"done"}


counts = st.sampled_from((0, 1, 2, 1 << 31, (1 << 32) - 1, MAX_FOUND - 1, MAX_COUNT - 1, MAX_COUNT)) | st.integers(0, 5)
ballots = st.builds(Ballot, counts, st.sampled_from(NAMES)) | st.just(NONE)


lost = st.sampled_from((1, LOST - 1)) | st.integers(1, 5)
restored = st.sets(lost, max_size=3).map(lambda numbers: tuple(sorted(numbers)))


@st.composite
def forged_epochs(draw: st.DrawFn) -> Epoch:
    members = tuple(sorted(draw(st.sets(st.sampled_from(NAMES), min_size=1))))
    carried = tuple(sorted(draw(st.sets(st.sampled_from(members)))))
    pairs = [(a, b) for a in members for b in members if a < b]
    edges = tuple(sorted(draw(st.sets(st.sampled_from(pairs))))) if pairs else ()
    before = dataclasses.replace(BEGIN, counter=draw(counts.filter(lambda each: each < MAX_COUNT)))
    k = draw(st.sampled_from((0, 1, 20, MAX_ITERATION - 1, MAX_ITERATION)))
    away = draw(st.lists(st.sampled_from((*NAMES, "stranger"))).map(tuple))
    return following(
        before,
        draw(st.sampled_from(NAMES)),
        k,
        members,
        carried,
        edges,
        away,
        draw(restored),
        forced=draw(st.booleans()),
    )


either = st.just(BEGIN) | forged_epochs()
notes = st.builds(
    EpochNote,
    st.sampled_from(NAMES), counts, counts, either, st.sampled_from((-1, 0, 3, MAX_ITERATION)), st.booleans(),
    st.lists(st.text(max_size=5), max_size=3).map(tuple), ballots,
    st.none() | st.builds(Vote, ballots, either),
    st.none() | st.builds(Offer, ballots, st.none() | either, st.booleans()),
    st.just(0) | lost,
)  # fmt: skip


@costly(90)
@given(st.lists(st.tuples(notes, st.sampled_from(NAMES), st.floats(0.0, 3.0)), max_size=6), st.sampled_from((None, 30)))
def test_whatever_notes_say_no_robot_ends_and_all_that_it_tells_can_be_read(
    lies: list[tuple[EpochNote, str, float]], last: int | None
) -> None:
    world = World(LINE, last=last)
    world.start_all()
    for lie, robot, pause in lies:
        world.run(pause)
        if robot in world.processes:
            world.processes[robot].take(
                lambda other, lie=lie: other.lockstep.receive_note("r1", lie.encode(), world.now)
            )
    world.run(3.0)
    for process in world.processes.values():
        note = process.lockstep.epochs._mine
        assert EpochNote.decode(note.encode()) == note
        assert decode(SavedEpochs, encode(process.lockstep.epochs.kept), "") == process.lockstep.epochs.kept
        assert not any(count for name, count in process.lockstep.counters.items() if name == "malformed note")
