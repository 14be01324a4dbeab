"""The journal of a recording's file: killed by -9, and gone on with by the next process."""

import itertools
import mmap
import os
from collections import Counter

import pytest
from needs import fill, small_disk
from recorded_numbers import TOPIC, numbers

from swarm.recording.file import RecordingFile
from swarm.recording.journal import HALF, NO_OWNER, Journal, owner_of

pytest_plugins = ("recording_fixtures",)


class Killed(BaseException):
    """Stands for SIGKILL: whatever was under way does not go on."""


def killed(file):
    """End a file as a killed process leaves it: the thread is gone, nothing is flushed."""
    file._ending.set()
    file._thread.join()
    os.close(file._file)
    file._file = None


@pytest.mark.parametrize("flushed", range(6))
def test_with_a_journal_the_next_process_puts_in_what_was_not_written(open_file, tmp_path, flushed):
    path, journal = tmp_path / "x.mcap", tmp_path / "journal"
    first = open_file(journal=journal)
    first.metadata("run", {"start": "1"})
    for i in range(5):
        first.write(TOPIC if i % 2 else "swarm/r0/y", float(i), {"i": i})
        if i < flushed:
            first.flush()
    killed(first)
    assert numbers(path)[0] == list(range(flushed)) if flushed < 5 else list(range(5))
    second = open_file(journal=journal, append=True)
    second.write(TOPIC, 5.0, {"i": 5})
    killed(second)  # and once more
    third = open_file(journal=journal, append=True)
    third.write(TOPIC, 6.0, {"i": 6})
    third.close()
    found, reader = numbers(path)
    assert found == list(range(7))
    assert reader.finished
    assert reader.damage == []
    assert reader.metadata == [("run", {"start": "1"})]


@pytest.mark.parametrize("moment", ["before", "torn", "after"])
def test_killed_while_it_wrote_nothing_is_lost_or_doubled(open_file, tmp_path, monkeypatch, moment):
    path, journal = tmp_path / "x.mcap", tmp_path / "journal"
    file = open_file(journal=journal)
    file.write(TOPIC, 0.0, {"i": 0})
    file.flush()
    file.write(TOPIC, 1.0, {"i": 1})
    pwrite = os.pwrite

    def kill(handle, data, at):
        if moment != "before":
            pwrite(handle, data if moment == "after" else data[:-9], at)
        raise Killed

    monkeypatch.setattr(os, "pwrite", kill)
    with pytest.raises(Killed):
        file.flush()
    monkeypatch.undo()
    file.write(TOPIC, 2.0, {"i": 2})
    killed(file)
    again = open_file(journal=journal, append=True)
    again.close()
    assert numbers(path)[0] == [0, 1, 2]


class Steps:
    """Counts what a process does to file and journal, and kills it after so many steps."""

    def __init__(self, monkeypatch, left):
        self.left, self.done = left, 0
        steps = self
        pwrite, ftruncate, real = os.pwrite, os.ftruncate, mmap.mmap

        class Map(real):
            def __setitem__(self, where, data):
                steps.step()
                super().__setitem__(where, data)

        def half_written(handle, data, at):
            steps.step(lambda: pwrite(handle, data[: len(data) // 2], at))
            return pwrite(handle, data, at)

        def truncated(handle, size):
            steps.step()
            return ftruncate(handle, size)

        monkeypatch.setattr(mmap, "mmap", Map)
        monkeypatch.setattr(os, "pwrite", half_written)
        monkeypatch.setattr(os, "ftruncate", truncated)

    def step(self, torn=lambda: None):
        if self.done == self.left:
            torn()
            raise Killed
        self.done += 1


@pytest.mark.parametrize("flushed", [(), (0, 2), (0, 1, 2, 3, 4)])
def test_a_recorder_that_is_killed_again_while_it_restores_its_journal_loses_nothing(
    open_file, tmp_path, monkeypatch, flushed
):
    """At every step of the second process: each record whose `write` returned is in the file at last, once."""
    path, journal = tmp_path / "x.mcap", tmp_path / "journal"
    for left in itertools.count():
        path.unlink(missing_ok=True)
        journal.unlink(missing_ok=True)
        first = open_file(journal=journal)
        first.metadata("run", {"start": "1"})
        for i in range(6):
            first.write(TOPIC if i % 2 else "swarm/r0/y", i * 0.6, {"i": i})
            if i in flushed:
                first.flush()
        killed(first)
        said, done, second = 6, False, None
        with monkeypatch.context() as patch:
            Steps(patch, left)
            try:
                second = RecordingFile(path, Counter(), append=True, journal=journal, min_free=0)
                for i in (6, 7):
                    second.write(TOPIC, i * 0.6, {"i": i})
                    said = i + 1
                    second.flush()
                done = True
            except Killed:
                pass
            if second is not None:
                killed(second)
        third = open_file(journal=journal, append=True)
        third.close()
        found, reader = numbers(path)
        assert found[:said] == list(range(said)), left
        assert found in (list(range(said)), list(range(said + 1))), left
        assert reader.damage == []
        assert reader.metadata == [("run", {"start": "1"})]
        if done:
            assert left > 8
            return


def test_a_journal_waits_where_the_disk_has_no_room_for_what_it_holds(open_file, tmp_path):
    path, journal = tmp_path / "x.mcap", tmp_path / "journal"
    first = open_file(journal=journal)
    for i in range(4):
        first.write(TOPIC, float(i), {"i": i})
    killed(first)
    second = open_file(journal=journal, append=True, min_free=1 << 62)
    assert "are free on its disk" in second.problem
    killed(second)  # before there was room
    third = open_file(journal=journal, append=True, min_free=1 << 62)
    third._min_free = 0
    third.flush()
    assert third.problem == ""
    third.write(TOPIC, 4.0, {"i": 4})
    killed(third)
    open_file(journal=journal, append=True).close()
    assert numbers(path)[0] == [0, 1, 2, 3, 4]


def test_a_journal_owns_its_blocks_so_that_a_full_disk_cannot_kill_the_process(tmp_path):
    with small_disk(tmp_path / "disk", 2 * 1024 * 1024) as disk:
        journal = Journal(disk / "journal")
        fill(disk / "ballast")
        journal.begin(0, NO_OWNER)
        for half in range(2):
            for _ in range(HALF // 1024 - 1):
                journal.add(bytes(1024))  # without blocks: SIGBUS
            journal.turn(half)
        journal.close()
        with pytest.raises(OSError, match="No space left"):
            Journal(disk / "another")


def test_a_journal_that_is_too_small_for_a_full_disk_takes_nothing_back(open_file, tmp_path):
    path, journal = tmp_path / "x.mcap", tmp_path / "journal"
    file = open_file(journal=journal)
    file.write(TOPIC, 0.0, {"i": 0})
    file.flush()
    for i in range(1, 31):
        file.write(TOPIC, float(i), {"i": i, "text": "x" * 20_000})
    file.flush()
    killed(file)
    again = open_file(journal=journal, append=True)
    again.close()
    assert numbers(path)[0] == list(range(31))


def test_a_journal_that_overflowed_while_the_disk_was_full_takes_nothing_back(open_file, tmp_path):
    path, journal = tmp_path / "x.mcap", tmp_path / "journal"
    file = open_file(journal=journal, min_free=1 << 62)
    file.write(TOPIC, 0.0, {"i": 0})
    file.flush()  # there is no room: the other half waits from now on
    for i in range(1, 31):
        file.write(TOPIC, float(i), {"i": i, "text": "x" * 20_000})
    file.flush()
    file._min_free = 0
    file.flush()
    killed(file)
    assert numbers(path)[0] == list(range(31))
    again = open_file(journal=journal, append=True)
    again.close()
    assert numbers(path)[0] == list(range(31))


def test_a_new_run_does_not_take_the_journal_of_another(open_file, tmp_path):
    journal = tmp_path / "journal"
    file = open_file(journal=journal)
    file.write(TOPIC, 0.0, {"i": 0})
    killed(file)
    again = open_file(journal=journal)
    again.write(TOPIC, 1.0, {"i": 1})
    again.close()
    assert numbers(tmp_path / "x.mcap")[0] == [1]


def test_a_journal_of_junk_is_left_out(open_file, tmp_path, caplog):
    journal = tmp_path / "journal"
    record = b"\x05" + (22).to_bytes(8, "little") + bytes(22)
    with (tmp_path / "x.mcap").open("wb") as recording:
        head = b"BLJOUR1\n" + owner_of(recording.fileno())
    journal.write_bytes(head + (8).to_bytes(8, "little") + len(record).to_bytes(8, "little") + record)
    file = open_file(journal=journal, append=True)
    file.write(TOPIC, 1.0, {"i": 1})
    file.close()
    assert numbers(tmp_path / "x.mcap")[0] == [1]
    assert "a message of channel 0, which is not described" in caplog.text


def test_a_run_that_is_gone_on_with_does_not_take_the_journal_of_another(open_file, tmp_path):
    """One app uses one journal for all its runs: what a killed process has left there may be of another file."""
    journal = tmp_path / "journal"
    first = open_file(tmp_path / "a.mcap", journal=journal)
    for i in range(100):
        first.write(TOPIC, float(i), {"i": i})
    first.close()
    other = open_file(tmp_path / "b.mcap", journal=journal)
    for i in range(3):
        other.write(TOPIC, float(i), {"i": 1000 + i})
    killed(other)
    again = open_file(tmp_path / "a.mcap", journal=journal, append=True)
    again.write(TOPIC, 100.0, {"i": 100})
    again.close()
    assert numbers(tmp_path / "a.mcap")[0] == list(range(101))


def test_a_journal_that_cannot_be_used_is_no_longer_there_for_the_next_process(open_file, tmp_path, monkeypatch):
    """It would take what was left there before for the end of the file, which has grown since."""
    journal = tmp_path / "journal"
    first = open_file(journal=journal)
    first.write(TOPIC, 0.0, {"i": 0})
    killed(first)

    def refuse(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as without:
        without.setattr("swarm.recording.file.Journal", refuse)
        second = open_file(journal=journal, append=True)
        for i in range(1, 50):
            second.write(TOPIC, float(i), {"i": i})
        second.close()
    third = open_file(journal=journal, append=True)
    third.close()
    assert numbers(tmp_path / "x.mcap")[0] == list(range(1, 50))
