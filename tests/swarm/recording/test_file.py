"""The file of a recording: whole, cut short, gone on with, on a disk that is full."""

import errno
import os
import subprocess
import sys
import threading
import time
from collections import Counter

import pytest
from needs import fill, small_disk
from recorded_numbers import TOPIC, numbers

from bench.rigs.running import running
from swarm.recording import file as module
from swarm.recording.file import RecordingFile

pytest_plugins = ("recording_fixtures",)


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


def test_a_defect_of_the_recording_thread_ends_the_recording_and_nothing_else(open_file, monkeypatch, caplog):
    monkeypatch.setattr(module, "FLUSH_S", 0.01)
    told, watched = [], threading.Event()

    def flush(file):
        watched.wait(30.0)
        return {}["a defect"]

    monkeypatch.setattr(RecordingFile, "flush", flush)
    file = open_file()
    file.watched = told.append
    watched.set()
    file._thread.join(30.0)
    assert not file._thread.is_alive()
    assert told == ["defect of the recording: KeyError('a defect')"]
    assert "the recording thread has a defect" in caplog.text
    monkeypatch.undo()


def test_a_recording_that_has_ended_is_on_the_disk(open_file, monkeypatch):
    """Its robot may be switched off at once."""
    calls = []
    pwrite, sync = os.pwrite, os.fdatasync
    monkeypatch.setattr(os, "pwrite", lambda *words: calls.append("write") or pwrite(*words))
    monkeypatch.setattr(os, "fdatasync", lambda file: calls.append("sync") or sync(file))
    file = open_file()
    file.write(TOPIC, 0.0, {"i": 0})
    file.close()
    assert calls[-2:] == ["write", "sync"]


@pytest.mark.parametrize("failing", ["survey", "set_aside"])
def test_a_recording_that_cannot_be_read_is_not_overwritten(open_file, tmp_path, monkeypatch, failing):
    """A card may give an error once."""
    file = open_file()
    for number in range(20):
        file.write(TOPIC, number, {"value": float(number)})
    file.close()
    path = tmp_path / "x.mcap"
    if failing == "set_aside":
        path.write_bytes(b"something else" * 100)
    before = path.read_bytes()

    def fails(*_):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(module, failing, fails)
    counters = Counter()
    file = open_file(counters=counters, append=True)
    file.write(TOPIC, 21.0, {"value": 21.0})
    file.close()
    assert path.read_bytes() == before
    assert "Input/output error" in file.problem
    assert counters == {"records_lost": 1}
