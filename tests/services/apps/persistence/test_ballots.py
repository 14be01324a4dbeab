"""The file of a robot's votes: on the disk before a vote is told, and never read as another vote."""

import errno
import os
import stat
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from needs import fill, small_disk
from power_cut import Disk, Killed

from services.apps.persistence.ballots import BallotFile
from swarm.core.epochs.notes import NONE, Ballot, EpochNote, SavedEpochs, first
from swarm.errors import LocalError

BEGIN = first(("r0", "r1"), (("r0", "r1"),), 7)
NOTE = EpochNote("r0", 1, 0, BEGIN, -1, True, (), NONE, None, None, 0)


def vote(number: int) -> SavedEpochs:
    return SavedEpochs(0xA1, 0x9F, replace(NOTE, promised=Ballot(number, "r1")))


def read(state: Path) -> tuple[SavedEpochs | None, bool]:
    """What the next process of the app finds, and whether it takes its vote for lost."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SWARM_STATE", str(state))
        file = BallotFile("x")
        kept = file.read()
        file.close()
        return kept, file.lost


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SWARM_STATE", str(tmp_path / "state"))
    return tmp_path / "state"


def test_a_robot_that_has_never_voted_knows_that(state: Path) -> None:
    assert read(state) == (None, False)
    assert read(state) == (None, False)


def test_what_was_voted_last_is_read(state: Path) -> None:
    file = BallotFile("x")
    for number in (1, 2, 3):
        file.write(vote(number))
    file.close()
    assert read(state) == (vote(3), False)


def test_a_vote_is_on_the_disk_when_it_may_be_told(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a kill or a power cut at any call the next process finds the vote before or the one under way, never a lost
    one; once `write` has returned it finds that one."""
    disk, told = Disk(state), []
    with disk.recorded(monkeypatch):
        file = BallotFile("x")
        file.read()
        told.append((len(disk.calls), None))
        for number in (1, 2, 3):
            file.write(vote(number))
            told.append((len(disk.calls), vote(number)))
    file.close()
    for found in disk.states():
        kept, lost = read(found.lay_out(state.parent / "found"))
        assert not lost
        at = max((index for index, (calls, _) in enumerate(told) if calls <= found.calls), default=0)
        assert kept in [each for _, each in told[at : at + 2]], (found.calls, disk.calls)
        if found.calls == told[at][0]:
            assert kept == told[at][1]


def test_a_vote_that_was_read_survives_the_loss_of_one_copy(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that was killed between the two copies of a vote leaves one; the next process makes it two again."""
    BallotFile("x").write(vote(1))
    disk = Disk(state)
    disk.kill_after = 1
    with disk.recorded(monkeypatch), pytest.raises(Killed):
        BallotFile("x").write(vote(2))
    assert read(state) == (vote(2), False)
    path = state / "epochs" / "x.votes"
    whole = path.read_bytes()
    half = len(whole) // 2
    for torn in (bytes(half) + whole[half:], whole[:half] + bytes(half)):
        path.write_bytes(torn)
        assert read(state) == (vote(2), False)


@given(st.integers(0, 1), st.integers(0, 250), st.binary(min_size=1, max_size=80))
def test_damage_in_one_copy_takes_nothing_away(
    tmp_path_factory: pytest.TempPathFactory, copy: int, at: int, garbage: bytes
) -> None:
    state = tmp_path_factory.mktemp("state")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SWARM_STATE", str(state))
        file = BallotFile("x")
        file.write(vote(1))
        file.write(vote(2))
        file.close()
    path = state / "epochs" / "x.votes"
    whole = bytearray(path.read_bytes())
    at += copy * len(whole) // 2
    whole[at : at + len(garbage)] = garbage
    path.write_bytes(whole)
    assert read(state) == (vote(2), False)


@pytest.mark.parametrize("damaged", [b"", b"\0" * 300_000, b"garbage" * 50_000, b"BLSNAP1\n", None])
def test_a_damaged_file_is_a_lost_vote_not_one_that_was_never_given(state: Path, damaged: bytes | None) -> None:
    file = BallotFile("x")
    file.write(vote(1))
    file.close()
    path = state / "epochs" / "x.votes"
    path.write_bytes(path.read_bytes()[:100] if damaged is None else damaged)
    if damaged is None:
        path.write_bytes(path.read_bytes()[:60])
    assert read(state) == (None, True)
    file = BallotFile("x")
    file.read()
    file.write(vote(2))  # and it can be written anew
    file.close()
    assert read(state) == (vote(2), False)


def test_a_file_of_another_release_is_a_lost_vote(state: Path) -> None:
    file = BallotFile("x")
    file._write(b"\x81\xa4what\xa4ever")
    file.close()
    assert read(state) == (None, True)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_of_another_user_is_named(state: Path) -> None:
    BallotFile("x").close()
    (state / "epochs" / "x.votes").chmod(0)
    with pytest.raises(LocalError, match=r"epochs/x\.votes: .*Permission denied"):
        BallotFile("x")


def test_a_file_that_may_not_be_opened_is_named(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the file of another user, which root cannot see: the votes are there and cannot be read."""
    BallotFile("x").close()
    real = os.open

    def refuse(path: object, *rest: int) -> int:
        if str(path).endswith("x.votes"):
            raise PermissionError(errno.EACCES, "Permission denied")
        return real(path, *rest)  # type: ignore[call-overload, no-any-return]

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(LocalError, match=r"epochs/x\.votes: .*Permission denied"):
        BallotFile("x")


def test_on_a_full_disk_a_vote_can_be_kept_and_a_killed_process_comes_back(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 1024 * 1024) as disk, pytest.MonkeyPatch.context() as patch:
        patch.setenv("SWARM_STATE", str(disk))
        file = BallotFile("x")
        fill(disk / "ballast")
        for number in range(20):
            file.write(vote(number))
        again = BallotFile("x")  # the process before was killed
        assert again.read() == vote(19)
        again.write(vote(20))
        assert read(disk) == (vote(20), False)
        with pytest.raises(LocalError, match=r"epochs/y\.votes: No space left on device"):
            BallotFile("y")
        again.close()
        file.close()


def test_a_new_vote_file_is_whole_after_a_cut_while_it_is_made(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(state)
    with disk.recorded(monkeypatch):
        BallotFile("x").close()
    assert stat.S_ISREG((state / "epochs" / "x.votes").stat().st_mode)
    for found in disk.states():
        assert read(found.lay_out(state.parent / "found")) == (None, False)
