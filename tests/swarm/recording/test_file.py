"""The file of a recording: killed, gone on with, on a disk that is full."""

import itertools
import mmap
import os
import subprocess
import sys
import time
from collections import Counter

import pytest
from needs import fill, small_disk

from bench.rigs.running import running
from swarm.recording import file as module
from swarm.recording.file import RecordingFile
from swarm.recording.journal import HALF, Journal
from swarm.recording.reader import RecordingReader

TOPIC = "swarm/r0/x"


@pytest.fixture
def open_file(tmp_path):
    opened = []

    def open_(path=None, counters=None, **options):
        counters = Counter() if counters is None else counters
        it = RecordingFile(path or tmp_path / "x.mcap", counters, **{"append": False, "min_free": 0, **options})
        opened.append(it)
        return it

    yield open_
    for it in opened:
        it.close()


def numbers(path):
    reader = RecordingReader(path)
    return [sample.message["i"] for sample in reader.samples()], reader


def test_a_closed_recording_is_whole(open_file, tmp_path):
    file = open_file()
    file.metadata("run", {"app": "x"})
    for i in range(10):
        file.write(TOPIC, 1.0 + i, {"i": i})
    file.close()
    found, reader = numbers(tmp_path / "x.mcap")
    assert found == list(range(10))
    assert reader.finished
    assert reader.metadata == [("run", {"app": "x"})]


def test_a_reader_of_an_ended_file_goes_on_when_another_process_does(open_file, tmp_path):
    path = tmp_path / "x.mcap"
    file = open_file()
    file.write(TOPIC, 1.0, {"i": 1})
    file.close()
    found, reader = numbers(path)
    assert (found, reader.finished) == ([1], True)
    again = open_file(append=True)
    again.write(TOPIC, 2.0, {"i": 2})
    again.flush()
    assert [sample.message["i"] for sample in reader.samples()] == [2]
    assert not reader.finished


@pytest.mark.parametrize("lost", [0, 1, 5, 60])
def test_another_process_goes_on_behind_what_is_whole(open_file, tmp_path, lost):
    path = tmp_path / "x.mcap"
    first = open_file()
    first.metadata("run", {"start": "1"})
    for i in range(3):
        first.write(TOPIC, float(i), {"i": i})
        first.flush()
    size = path.stat().st_size
    first.close()
    os.truncate(path, size - lost)  # killed while it wrote
    again = open_file(append=True)
    again.metadata("run", {"start": "2"})
    again.write(TOPIC, 3.0, {"i": 3})
    again.write("swarm/r0/y", 3.0, {"i": 4})
    again.close()
    found, reader = numbers(path)
    assert found == ([0, 1, 2, 3, 4] if lost == 0 else [0, 1, 3, 4])
    assert reader.finished
    assert reader.damage == []
    assert [entries["start"] for _, entries in reader.metadata] == ["1", "2"]
    mcap = pytest.importorskip("mcap.reader")
    with path.open("rb") as stream:
        summary = mcap.SeekingReader(stream, validate_crcs=True).get_summary()
        assert summary.statistics.message_count == len(found)
        assert len(list(mcap.SeekingReader(stream, validate_crcs=True).iter_messages())) == len(found)


def test_a_finished_file_can_be_gone_on_with(open_file, tmp_path):
    for i in range(3):
        file = open_file(append=i > 0)
        file.write(TOPIC, float(i), {"i": i})
        file.close()
    assert numbers(tmp_path / "x.mcap")[0] == [0, 1, 2]


def test_a_new_run_begins_the_file_anew(open_file, tmp_path):
    for i in range(2):
        file = open_file()
        file.write(TOPIC, float(i), {"i": i})
        file.close()
    assert numbers(tmp_path / "x.mcap")[0] == [1]


def test_what_is_none_of_ours_is_put_aside(open_file, tmp_path, caplog):
    (tmp_path / "x.mcap").write_text("my thesis")
    file = open_file(append=True)
    file.write(TOPIC, 1.0, {"i": 1})
    file.close()
    assert (tmp_path / "x.damaged").read_text() == "my thesis"
    assert numbers(tmp_path / "x.mcap")[0] == [1]
    assert "it is now x.damaged" in caplog.text


def test_a_recording_that_cannot_be_made_is_counted_not_fatal(open_file, tmp_path, caplog):
    counters = Counter()
    file = open_file(tmp_path / "none" / "x.mcap", counters)
    for i in range(3):
        file.write(TOPIC, 1.0, {"i": i})
    file.flush()
    assert counters["records_lost"] == 3
    assert sum("cannot be recorded, the run goes on: No such file" in message for message in caplog.messages) == 1


def test_a_disk_that_is_nearly_full_is_left_alone_and_gone_on_with(open_file, tmp_path, monkeypatch, caplog):
    counters = Counter()
    monkeypatch.setattr(module, "MAX_WAITING", 2000)
    file = open_file(counters=counters, min_free=1 << 62)
    for i in range(100):
        file.write(TOPIC, 0.0, {"i": i})
        file.flush()
    path = tmp_path / "x.mcap"
    assert path.stat().st_size == 0
    assert 0 < counters["records_lost"] < 100
    file._min_free = 0  # somebody has made room
    file.flush()
    file.write(TOPIC, 1.0, {"i": 100})
    file.close()
    kept = 100 - counters["records_lost"]
    assert numbers(path)[0] == [*range(kept), 100]
    assert sum("are free on its disk" in message for message in caplog.messages) == 1


def test_a_write_that_was_cut_short_is_finished_later(open_file, tmp_path, monkeypatch):
    file = open_file()
    file.write(TOPIC, 0.0, {"i": 0})
    file.flush()
    pwrite = os.pwrite
    monkeypatch.setattr(os, "pwrite", lambda handle, data, at: pwrite(handle, data[:7], at))
    file.write(TOPIC, 1.0, {"i": 1})
    file.flush()
    assert numbers(tmp_path / "x.mcap")[0] == [0]
    monkeypatch.undo()
    file.close()
    found, reader = numbers(tmp_path / "x.mcap")
    assert found == [0, 1]
    assert reader.finished


WRITES = """
import sys
from collections import Counter
from pathlib import Path
from swarm.recording.file import RecordingFile
file = RecordingFile(Path(sys.argv[1]), Counter(), append=False)
i = 0
while sys.stdin.readline():
    for _ in range(1000):
        file.write("swarm/r0/x", float(i), {"i": i})
        i += 1
    print(i, flush=True)
"""


def test_killed_it_has_lost_no_more_than_what_was_not_yet_written(tmp_path):
    """Half a second after a message was recorded it is in the file, whatever becomes of the process."""
    path = tmp_path / "x.mcap"
    command, pipe = [sys.executable, "-c", WRITES, path], subprocess.PIPE
    with running(command, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write("\n")
        process.stdin.flush()
        assert process.stdout.readline() == "1000\n"
        end = time.monotonic() + 60
        while not path.exists() or not path.stat().st_size or len(numbers(path)[0]) < 1000:
            assert time.monotonic() < end
            time.sleep(0.02)
        process.kill()
    found, reader = numbers(path)
    assert found == list(range(1000))
    assert not reader.finished


# Killed by -9, and gone on with by the next process


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
        journal.begin(0)
        for half in range(2):
            for _ in range(HALF // 1024 - 1):
                journal.add(bytes(1024))  # without blocks: SIGBUS
            journal.turn(half)
        journal.close()
        with pytest.raises(OSError, match="No space left"):
            Journal(disk / "another")


def test_on_a_full_disk_the_recording_says_so_and_goes_on_when_there_is_room(open_file, tmp_path):
    with small_disk(tmp_path / "disk", 256 * 1024) as disk:
        file = open_file(disk / "x.mcap")
        file.write(TOPIC, 0.0, {"i": 0})
        file.flush()
        fill(disk / "ballast")
        for i in range(1, 100):
            file.write(TOPIC, float(i), {"i": i, "text": "x" * 1000})
        file.flush()
        assert file.problem in ("No space left on device", "the disk is full", "less than 0 MiB are free on its disk")
        (disk / "ballast").unlink()
        file.flush()
        assert file.problem == ""
        file.close()
        assert numbers(disk / "x.mcap")[0] == list(range(100))


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
    head = b"BLJOUR1\n" + bytes(8)
    journal.write_bytes(head + (8).to_bytes(8, "little") + len(record).to_bytes(8, "little") + record)
    file = open_file(journal=journal, append=True)
    file.write(TOPIC, 1.0, {"i": 1})
    file.close()
    assert numbers(tmp_path / "x.mcap")[0] == [1]
    assert "a message of channel 0, which is not described" in caplog.text


def test_a_defect_of_the_recording_thread_ends_the_recording_and_nothing_else(open_file, monkeypatch, caplog):
    monkeypatch.setattr(module, "FLUSH_S", 0.01)
    told = []
    file = open_file()
    file.watched = told.append
    monkeypatch.setattr(file, "flush", lambda: {}["a defect"])
    file._thread.join(30.0)
    assert not file._thread.is_alive()
    assert told == ["defect of the recording: KeyError('a defect')"]
    assert "the recording thread has a defect" in caplog.text
    monkeypatch.undo()
