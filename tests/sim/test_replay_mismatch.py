"""A replay whose files do not match is named: what is wrong with a file, or that the trajectory is left, and why."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from laptop.cli.runs import export
from sim.virtual.run import simulate
from swarm.errors import RecordingError
from swarm.recording.run import Run
from swarm.recording.thesis_ranges import read_folder

THESIS = ("localization", "--algorithm", "thesis", "--set", "check=false", "--step-size", "4e-6")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The files of a run of three robots, by name."""
    place = tmp_path_factory.mktemp("run") / "run"
    simulate(*THESIS, "--robots", "3", "--iterations", "40", "--noise", "thesis", "--record", str(place))
    return export._layouts(Run(place))


def written(place: Path, files: dict[str, str]) -> str:
    for name, text in files.items():
        (place / name).write_text(text)
    return str(place)


def replay(place: str) -> dict:
    return simulate(*THESIS, "--replay", place, "--latency", "0ms")[0]


def test_a_replay_that_follows_is_no_problem(tmp_path: Path, recorded: dict[str, str]) -> None:
    report = replay(written(tmp_path, recorded))
    assert report["replay_deviation_cm"] < 1e-9
    assert report["problems"] == []


def metres(text: str) -> str:
    rows = [line.split(",") for line in text.splitlines()]
    for row in rows:
        for column in (*range(1, 7), *range(9, 12)):
            if column < len(row):
                row[column] = repr(float(row[column]) / 100)
    return "".join(",".join(row) + "\n" for row in rows)


def without_rows(text: str) -> str:
    lines = text.splitlines(keepends=True)
    return "".join(lines[:21] + lines[25:])


WRONG: dict[str, tuple[Callable[[dict[str, str]], dict[str, str]], str]] = {
    "the last robot's file is missing": (
        lambda files: {name: files[name] for name in ("0.csv", "1.csv")},
        "a robot's file or rows are missing",
    ),
    "rows are missing": (
        lambda files: files | {"1.csv": without_rows(files["1.csv"])},
        "a robot's file or rows are missing",
    ),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_replay_that_leaves_its_recording_is_a_problem(tmp_path: Path, recorded: dict[str, str], kind: str) -> None:
    change, reason = WRONG[kind]
    (problem,) = replay(written(tmp_path, change(recorded)))["problems"]
    assert "the replay leaves the recorded trajectory by" in problem
    assert reason in problem


def test_what_is_wrong_with_a_file_is_named(tmp_path: Path, recorded: dict[str, str]) -> None:
    lines = recorded["1.csv"].splitlines(keepends=True)
    repeated, shuffled = [*lines[:9], lines[8], *lines[9:]], [*lines[:8], lines[10], lines[9], lines[8], *lines[11:]]
    far = [
        line if "," not in line or len(line.split(",")) < 12 else ",".join([*line.split(",")[:9], "1e300", "1,1\n"])
        for line in lines
    ]
    for text, message in (
        ("".join(repeated), "1.csv:10: the same line as the one before: rows were repeated"),
        ("".join(shuffled), "1.csv:11: its time is .* s before the line before: rows are shuffled"),
        ("".join(far), "1.csv:2: a length of 1e\\+300 cm: expected at most 100000"),
        ("\ufeff" + recorded["1.csv"], "1.csv:1: it begins with a byte-order mark"),
    ):
        written(tmp_path, recorded | {"1.csv": text})
        with pytest.raises(RecordingError, match=message):
            read_folder(tmp_path)
    (tmp_path / "1.csv").unlink()
    with pytest.raises(RecordingError, match=r"1\.csv: missing, though 2\.csv is there"):
        read_folder(tmp_path)
    os.mkfifo(tmp_path / "1.csv")
    with pytest.raises(RecordingError, match=r"1\.csv: cannot be read: it is no file"):
        read_folder(tmp_path)


def test_lengths_in_another_unit_are_named(tmp_path: Path, recorded: dict[str, str]) -> None:
    with pytest.raises(RecordingError, match="the lengths are not in cm"):
        replay(written(tmp_path, {name: metres(text) for name, text in recorded.items()}))


def test_the_command_ends_with_1(tmp_path: Path, recorded: dict[str, str]) -> None:
    place = written(tmp_path, {name: recorded[name] for name in ("0.csv", "1.csv")})
    command = [sys.executable, "-m", "laptop.cli", "sim", *THESIS, "--replay", place, "--virtual"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1
    assert "problem     the replay leaves" in done.stdout
