"""What recordings may take of a robot's disk: the oldest finished runs go, those that go on never."""

import errno
import logging
import os
import subprocess
import sys
from collections import Counter

from conftest import costly
from hypothesis import given
from hypothesis import strategies as st

from bench.rigs.running import running
from swarm.recording import budget as module
from swarm.recording.budget import RESTING_S, Budget, runs_of
from swarm.recording.file import RecordingFile

NOW = 1_000_000.0
SIZE = 64 * 1024
"""Bytes of a run's recording here."""


def make(root, name, age, size=SIZE):
    """A run that was written to `age` s ago."""
    folder = root / name
    folder.mkdir(parents=True)
    (folder / "run.toml").write_text("app = 'x'\n")
    (folder / "r0.x.mcap").write_bytes(os.urandom(size))
    for path in (*folder.iterdir(), folder):
        os.utime(path, (NOW - age, NOW - age))
    return folder


def left(root):
    return sorted(path.name for path in root.iterdir())


def budget(root, runs):
    """Room for so many runs and a half."""
    return Budget(root, (runs + 0.5) * runs_of(root)[0].size, lambda: NOW)


def test_the_oldest_go_until_the_rest_has_room(tmp_path, caplog):
    for index, age in enumerate((9000, 400, 7000, 300)):
        make(tmp_path, f"x-{index}", age)
    with caplog.at_level(logging.WARNING, "record"):
        gone = budget(tmp_path, 2).keep()
    assert [run.path.name for run in gone] == ["x-0", "x-2"]
    assert left(tmp_path) == ["x-1", "x-3"]
    assert "x-0 is deleted, 0.1 MB: recordings may take 0.2 MB (recordings.budget)" in caplog.text
    assert budget(tmp_path, 2).keep() == []


def test_a_run_that_goes_on_stays_however_old_and_large(tmp_path, caplog):
    """Held by another process: this one's own locks would not hold up itself."""
    make(tmp_path, "x-1", 9000)
    code = (
        "import sys, os\nfrom swarm.recording.budget import hold\n"
        "file = os.open(sys.argv[1], os.O_RDWR)\nhold(file)\nprint('held', flush=True)\nsys.stdin.read()"
    )
    path = str(tmp_path / "x-1" / "r0.x.mcap")
    with running([sys.executable, "-c", code, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"held\n"
        tight = Budget(tmp_path, 1.0, lambda: NOW)
        with caplog.at_level(logging.WARNING, "record"):
            assert tight.keep() == tight.keep() == []
        assert caplog.text.count("none of them is over") == 1
    assert [run.path.name for run in Budget(tmp_path, 1.0, lambda: NOW).keep()] == ["x-1"]


def test_one_whose_process_is_being_started_again_stays(tmp_path):
    make(tmp_path, "x-1", RESTING_S - 1)
    assert Budget(tmp_path, 1.0, lambda: NOW).keep() == []
    assert len(Budget(tmp_path, 1.0, lambda: NOW + 2).keep()) == 1


def test_a_recording_says_that_it_goes_on(tmp_path):
    folder = tmp_path / "x-1"
    folder.mkdir()
    file = RecordingFile(folder / "r0.x.mcap", Counter(), append=False, min_free=0)
    assert [run.held for run in runs_of(tmp_path)] == [True]
    file.close()
    assert [run.held for run in runs_of(tmp_path)] == [False]


def test_without_a_folder_there_is_nothing_to_do(tmp_path):
    assert Budget(tmp_path / "none", 1.0, lambda: NOW).keep() == []


def test_what_cannot_be_deleted_is_said_and_the_next_one_goes(tmp_path, caplog, monkeypatch):
    make(tmp_path, "x-1", 9000)
    make(tmp_path, "x-2", 8000)
    delete = module._delete

    def broken(folder):
        if folder.name == "x-1":
            raise OSError(errno.EIO, "Input/output error")
        delete(folder)

    monkeypatch.setattr(module, "_delete", broken)
    with caplog.at_level(logging.WARNING, "record"):
        assert [run.path.name for run in Budget(tmp_path, 1.0, lambda: NOW).keep()] == ["x-2"]
    assert "x-1 cannot be deleted: Input/output error" in caplog.text


@costly(30)
@given(st.lists(st.integers(0, 3), max_size=5), st.integers(0, 5))
def test_what_is_left_is_the_newest_that_have_room(tmp_path_factory, ages, runs):
    root = tmp_path_factory.mktemp("runs")
    for index, age in enumerate(ages):
        make(root, f"x-{index}", RESTING_S + age)
    before = runs_of(root)
    if before:
        budget(root, runs).keep()
    kept = [run.path.name for run in before[max(0, len(before) - runs) :]]
    assert left(root) == sorted(kept)
