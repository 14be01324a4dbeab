"""The bytes of notes about a run's members, and the count by which robots stop."""

import contextlib
import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.core.epochs.notes import LOST, NONE, Ballot, EpochNote, Offer, Vote, first, following
from swarm.core.graph import Graph
from swarm.core.lockstep.stopping import Rule, Stopping
from swarm.errors import LocalError, PayloadError

BEGIN = first(("r2", "r0", "r1"), (("r0", "r1"), ("r1", "r2")), 0)
NEXT = following(BEGIN, "r1", 7, ("r0", "r1"), ("r0", "r1"), (("r0", "r1"),), ("r2",), (77,), forced=False)
NOTE = EpochNote("r0", 3, 9, BEGIN, 8, True, ("r2",), Ballot(2, "r1"), Vote(Ballot(2, "r1"), NEXT), None, 0)


def test_the_bytes_of_a_note() -> None:
    small = EpochNote("r0", 1, 2, first(("r0",), (), 0), 3, True, (), NONE, None, None, 5)
    assert small.encode().hex() == (
        "8ba5726f626f74a27230a5626972746801a776657273696f6e02a565706f63688ba66e756d62657200a7636f756e74657200a870726f"
        "706f736572a0a66265666f726500a16b00a76d656d6265727391a27230a76361727269656490a5656467657390a461776179" + ""
        "90a8726573746f72656490a6666f72636564c2a16b03a477656c6cc3a46465616690a870726f6d6973656482a5726f756e6400a5726f626f74a0a8616363657074"
        "6564c0a56f66666572c0a46c6f737405"
    )


@pytest.mark.parametrize(
    "note", [NOTE, dataclasses.replace(NOTE, epoch=NEXT, offer=Offer(Ballot(4, "r0"), None, forced=True))]
)
def test_a_note_comes_back(note: EpochNote) -> None:
    assert EpochNote.decode(note.encode()) == note


@pytest.mark.parametrize("lost", [-1, LOST, (1 << 64) - 1])
def test_a_number_of_a_lost_vote_that_is_out_of_range_is_refused(lost: int) -> None:
    with pytest.raises(PayloadError, match="epoch note: lost: expected an integer from 0"):
        EpochNote.decode(dataclasses.replace(NOTE, lost=lost).encode())


@given(st.binary(max_size=80), st.integers(0, 400), st.integers(0, 80))
def test_no_bytes_do_harm(garbage: bytes, at: int, cut: int) -> None:
    data = NOTE.encode()
    for wrong in (garbage, data[:at] + garbage + data[at + cut :]):
        with contextlib.suppress(PayloadError):
            assert isinstance(EpochNote.decode(wrong), EpochNote)


@pytest.mark.parametrize(
    "change",
    [
        {"members": ("r1", "r0")},
        {"members": ("r0", "r2")},
        {"carried": ("r0", "r9")},
        {"edges": (("r0", "r2"),)},
        {"edges": (("r0", "r0"),)},
        {"k": 8},
        {"number": 5},
        {"restored": (78,)},
    ],
)
def test_an_epoch_that_contradicts_itself_is_refused(change: dict[str, object]) -> None:
    wrong = dataclasses.replace(NEXT, **change)  # type: ignore[arg-type]
    with pytest.raises(PayloadError, match="epoch 1 of r1: it contradicts itself"):
        EpochNote.decode(dataclasses.replace(NOTE, epoch=wrong).encode())


def test_of_two_epochs_exactly_one_supersedes_the_other() -> None:
    other = following(BEGIN, "r2", 7, ("r2",), ("r2",), (), (), (), forced=True)
    assert NEXT.supersedes(BEGIN)
    assert not BEGIN.supersedes(NEXT)
    assert NEXT.supersedes(other) != other.supersedes(NEXT)
    assert not NEXT.supersedes(NEXT)
    assert not first(("r0",), (), 9).supersedes(BEGIN)


# -- the count by which robots stop ------------------------------------------------------------------------------------


@st.composite
def graphs(draw: st.DrawFn) -> Graph:
    n = draw(st.integers(1, 7))
    edges = {(draw(st.integers(0, j - 1)), j) for j in range(1, n)}
    more = [(i, j) for i in range(n) for j in range(i + 1, n)]
    edges |= set(draw(st.lists(st.sampled_from(more), max_size=5))) if more else set()
    return Graph([f"r{i}" for i in range(n)], [(f"r{i}", f"r{j}") for i, j in edges])


@given(graphs(), st.integers(1, 6), st.integers(0, 20), st.randoms(use_true_random=False))
def test_all_stop_together_and_only_when_all_were_content(graph: Graph, rounds: int, quiet_from: int, chance) -> None:
    """Robots are content now and then, and all of them for good from some iteration on."""
    cores = {name: Stopping(Rule(rounds=rounds), graph) for name in graph.names}
    counts = dict.fromkeys(graph.names, Stopping.first())
    content: list[dict[str, bool]] = []
    while not any(cores[name].over(counts[name]) for name in graph.names):
        now = {name: len(content) >= quiet_from or chance.random() < 0.8 for name in graph.names}
        content.append(now)
        counts = {
            name: cores[name].next(
                counts[name], [counts[other] for other in graph.neighbours(name)], content=now[name], seconds=0.0
            )
            for name in graph.names
        }
        assert len(content) < quiet_from + 40 + rounds
    assert all(cores[name].over(counts[name]) for name in graph.names)
    assert any(all(all(now.values()) for now in content[k : k + rounds]) for k in range(len(content) - rounds + 1)), (
        "never were all content for so long"
    )


def test_a_count_that_would_not_fit_is_refused() -> None:
    with pytest.raises(LocalError, match="stop after 70000 rounds: at most 65533 are possible"):
        Stopping(Rule(rounds=70000), Graph.of_shape("line", ["r0", "r1"]))
