"""A replay whose files do not match is named: what is wrong with a file, or that the trajectory is left, and why."""

import math
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import thinned

from laptop.cli.runs import export
from services.apps.builtin.localization import ALGORITHMS
from sim.report import END_BOUND_CM
from sim.virtual.run import simulate
from swarm.errors import RecordingError
from swarm.recording import thesis_csv
from swarm.recording.run import Run
from swarm.recording.thesis_ranges import read_folder

DATA = Path(os.environ.get("SWARM_THESIS_DATA") or Path(__file__).parents[3] / "shared" / "thesis-data")

THESIS = ("localization", "--algorithm", "thesis", "--set", "check=false", "--step-size", "4e-6")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The files of a run of three robots, by name."""
    place = tmp_path_factory.mktemp("run") / "run"
    simulate(*THESIS, "--robots", "3", "--iterations", "40", "--noise", "thesis", "--record", str(place))
    return export._layouts(Run(place), [])


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


def divided(text: str, divisors: dict[int, float]) -> str:
    """The file with some columns divided."""
    rows = [line.split(",") for line in text.splitlines()]
    for row in rows:
        for column, divisor in divisors.items():
            if column < len(row):
                row[column] = repr(float(row[column]) / divisor)
    return "".join(",".join(row) + "\n" for row in rows)


METRES = {1: 1e2, 2: 1e2, 3: 1e2, 4: 1e2, 5: 1e6, 6: 1e6, 8: 1e8, 9: 1e2, 10: 1e2, 11: 1e2}


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
        line if "," not in line or len(line.split(",")) < 12 else ",".join([*line.split(",")[:9], "1e15", "1,1\n"])
        for line in lines
    ]
    for text, message in (
        ("".join(repeated), "1.csv:10: the same line as the one before: rows were repeated"),
        ("".join(shuffled), "1.csv:11: its time is .* s before the line before: rows are shuffled"),
        ("".join(far), "1.csv:2: a length of 1e\\+15 cm: expected at most 100000"),
        (recorded["1.csv"].replace(",0.0,0.0,", ",1e300,0.0,", 1), "1.csv:1: column 2 is 1e\\+300, no number here"),
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
        replay(written(tmp_path, {name: divided(text, METRES) for name, text in recorded.items()}))
    for some in ({9: 100.0}, {1: 100.0, 2: 100.0}, {10: 100.0, 11: 100.0}, {9: 1.05}):
        changed = {name: divided(text, some) for name, text in recorded.items()}
        with pytest.raises(RecordingError, match=r"0\.csv:\d+: a cost of .* in column 9, the line's lengths give"):
            replay(written(tmp_path, changed))


@pytest.mark.parametrize("algorithm", thinned(sorted(ALGORITHMS.keys() - {"thesis"})))
def test_another_algorithm_ends_where_the_recording_does(tmp_path: Path, algorithm: str) -> None:
    """A recorded run that has settled at (0.5, 1.0), replayed; then with estimates that its measurements contradict."""
    places, files = ((0.5, 1.5), (1.0, 0.5), (1.5, 1.5)), {}
    for ends in ((0.5, 1.0), (0.5, 1.3)):
        for index, place in enumerate(places):
            rows = [(k, 0.1 * k, *(ends if k else (0.0, 0.0))) for k in range(200)]
            measured = {k: (math.dist(place, (0.5, 1.0)), *place) for k in range(1, 200)}
            files[f"{index}.csv"] = thesis_csv.localization(rows, measured)
        options = ("localization", "--algorithm", algorithm, "--replay", written(tmp_path, files), "--latency", "0ms")
        report = simulate(*options)[0]
        if ends == (0.5, 1.0):
            assert report["replay_deviation_cm"] < 5
            assert report["problems"] == []
        else:
            (problem,) = report["problems"]
            assert re.search("the replay ends .* cm from where the recording ends: likely the measurements", problem)


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings in {DATA}: set SWARM_THESIS_DATA to their folder")
@pytest.mark.parametrize("algorithm", sorted(ALGORITHMS.keys() - {"thesis"}))
@pytest.mark.parametrize("run", ["test_2", "test_3", "test_5"])
def test_the_thesis_recordings_keep_the_bound(run: str, algorithm: str) -> None:
    options = ("localization", "--algorithm", algorithm, "--replay", str(DATA / "localization" / run))
    report = simulate(*options, "--latency", "0ms")[0]
    assert report["replay_deviation_cm"] < END_BOUND_CM
    assert report["problems"] == []


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings in {DATA}: set SWARM_THESIS_DATA to their folder")
def test_without_a_robot_another_algorithm_ends_elsewhere(tmp_path: Path) -> None:
    files = {name: (DATA / "localization" / "test_3" / name).read_text() for name in ("0.csv", "1.csv")}
    (problem,) = simulate("localization", "--replay", written(tmp_path, files), "--latency", "0ms")[0]["problems"]
    assert "a robot's file is missing" in problem


def test_the_command_ends_with_1(tmp_path: Path, recorded: dict[str, str]) -> None:
    place = written(tmp_path, {name: recorded[name] for name in ("0.csv", "1.csv")})
    command = [sys.executable, "-m", "laptop.cli", "sim", *THESIS, "--replay", place, "--virtual"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1
    assert "problem     the replay leaves" in done.stdout
