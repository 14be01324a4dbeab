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
from sim.scenario import options, scenario
from sim.virtual.run import run_virtually
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
    run_virtually(*THESIS, "--robots", "3", "--iterations", "40", "--noise", "thesis", "--record", str(place))
    return export._layouts(Run(place), [])


def written(place: Path, files: dict[str, str]) -> str:
    for name, text in files.items():
        (place / name).write_text(text)
    return str(place)


def replay(place: str) -> dict:
    return run_virtually(*THESIS, "--replay", place, "--latency", "0ms")[0]


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
    problem = replay(written(tmp_path, change(recorded)))["problems"][-1]
    assert "the replay leaves the recorded trajectory by" in problem
    assert reason in problem


def iterations(text: str, begin: int, end: int) -> str:
    """The lines of some iterations, two each; those of state 0 are not among them."""
    return "".join(text.splitlines(keepends=True)[1 + 2 * begin : 1 + 2 * end])


def late(text: str, seconds: float) -> str:
    """The file by a clock that is fast."""
    return "".join(
        f"{float(t) + seconds!r},{rest}" for t, _, rest in (line.partition(",") for line in text.splitlines(True))
    )


def settled(place: Path, change: Callable[[dict[str, str]], dict[str, str]], *options: str) -> dict:
    """Replay, with another algorithm, a changed recording whose robots' clocks differ."""
    places, files = ((0.5, 1.5), (1.0, 0.5), (1.5, 1.5), (1.5, 0.5)), {}
    for index, (x, y) in enumerate(places):
        # Distances differ by 1 mm and ends by 1 cm, or each state would be the one before.
        rows = [(k, 1e9 + 0.1 * k, 0.5 + 0.01 * (k % 2) if k else 0.0, 1.0 if k else 0.0) for k in range(101)]
        measured = {k: (math.dist((x, y), (0.5, 1.0)) + 0.001 * (k % 7), x, y) for k in range(1, 101)}
        files[f"{index}.csv"] = late(thesis_csv.localization(rows, measured), 0.03 * index)
    options = ("localization", "--replay", written(place, change(files)), "--latency", "0ms", *options)
    return run_virtually(*options)[0]


def test_files_that_are_not_of_one_run_are_refused(tmp_path: Path) -> None:
    def again(text: str) -> str:
        return text.splitlines(True)[0] + "".join(iterations(text, k, k + 1) * (1 + (k == 30)) for k in range(100))

    def other_order(text: str) -> str:
        """The times stay, the rest of the lines does not."""
        lines = [line.partition(",") for line in text.splitlines(True)]
        rest = [line[2] for line in lines]
        rest[60:70] = rest[69:59:-1]
        return "".join(f"{t},{others}" for (t, _, _), others in zip(lines, rest, strict=True))

    for changed, message in (
        (lambda files: files["0.csv"], r"1\.csv:1: the measurements and estimates of 0\.csv: it is a copy"),
        (lambda files: late(files["0.csv"], 0.02), r"1\.csv:1: the measurements and estimates of 0\.csv: it is a copy"),
        (
            lambda files: again(files["1.csv"]),
            r"1\.csv:64: the state of line 62 once more, and 101 iterations where the",
        ),
        (lambda files: other_order(files["1.csv"]), r"1\.csv:62: marked as sent .* rows are shuffled or changed"),
        (lambda files: divided(files["1.csv"], {0: 1e-3}), r"1\.csv:1: a time of 1e\+12 s since 1970: divide .* ms"),
    ):
        with pytest.raises(RecordingError, match=message):
            settled(tmp_path, lambda files, changed=changed: files | {"1.csv": changed(files)})


def test_rows_that_are_missing_are_a_problem_where_estimates_have_settled(tmp_path: Path) -> None:
    def without(files: dict[str, str]) -> dict[str, str]:
        text = files["1.csv"]
        return files | {"1.csv": text.splitlines(True)[0] + iterations(text, 0, 50) + iterations(text, 55, 100)}

    assert settled(tmp_path, lambda files: files)["problems"] == []
    (problem,) = settled(tmp_path, without)["problems"]
    assert re.search(
        r"1\.csv:102: 0\.csv has . iterations between .* and 5 more in all: likely rows are missing", problem
    )


def test_times_in_another_unit_are_a_problem(tmp_path: Path) -> None:
    def milliseconds(names: tuple[str, ...]) -> Callable[[dict[str, str]], dict[str, str]]:
        def change(files: dict[str, str]) -> dict[str, str]:
            files = {name: late(text, -1e9) for name, text in files.items()}
            return files | {name: divided(files[name], {0: 1e-3}) for name in names}

        return change

    assert settled(tmp_path, milliseconds(()))["problems"] == []
    (problem,) = settled(tmp_path, milliseconds(("2.csv",)))["problems"]
    assert re.search(
        r"2\.csv:2: .* an iteration takes 100 s, the median of all files is 0\.1 s: likely .* unit", problem
    )
    assert len(settled(tmp_path, milliseconds(("0.csv", "1.csv", "2.csv", "3.csv")))["problems"]) == 4


def test_a_file_that_ends_early_is_named(tmp_path: Path) -> None:
    def cut(files: dict[str, str]) -> dict[str, str]:
        return files | {"1.csv": files["1.csv"].splitlines(True)[0] + iterations(files["1.csv"], 0, 50)}

    report = settled(tmp_path, cut)
    assert report["problems"] == []
    (early,) = report["early_ends"]
    assert re.search(r"1\.csv: it ends with iteration 50, in line 100; 0\.csv has 50 later ones", early)
    assert settled(tmp_path, cut, "--iterations", "30")["early_ends"] == []
    assert settled(tmp_path, lambda files: files)["early_ends"] == []


def test_files_that_were_exchanged_are_named(tmp_path: Path) -> None:
    def change(files: dict[str, str]) -> dict[str, str]:
        return files | {"0.csv": files["1.csv"], "1.csv": files["0.csv"]}

    assert settled(tmp_path, change)["problems"] == []  # nobody has said where the robots are
    robots = "".join(f'[[robots]]\nname = "r{index}"\n' for index in range(4))
    places = "[simulation.places]\nr0 = [0.5, 1.5, 0.0]\nr1 = [1.0, 0.5, 0.0]\n"
    config = tmp_path / "swarm.toml"
    config.write_text(f'network = "lab"\n{robots}[topology]\nshape = "line"\n{places}')
    (problem,) = settled(tmp_path, change, "--config", str(config))["problems"]
    assert re.search(r"0\.csv was recorded at the place of r1, .*1\.csv at that of r0: likely .* exchanged", problem)


def test_an_export_of_robots_at_one_time_is_accepted(tmp_path: Path) -> None:
    """Without latency and noise all iterations are at one time, and settled ones equal the ones before."""
    run = tmp_path / "run"
    options = ("--noise", "none", "--latency", "0ms", "--algorithm", "flood", "--iterations", "30")
    run_virtually("localization", *options, "--record", str(run))
    files = export._layouts(Run(run), [])
    report = run_virtually("localization", "--replay", written(tmp_path, files), "--algorithm", "flood")[0]
    assert report["problems"] == report["early_ends"] == []


def test_a_replay_that_is_shorter_than_the_wanted_iterations_says_so(tmp_path: Path, recorded: dict[str, str]) -> None:
    folder = written(tmp_path, recorded)
    more = options.parse(["localization", "--replay", folder, "--iterations", "1000", "--virtual"])
    assert "the recordings have 40 rows: the run ends after 40 iterations" in scenario.build(more, tmp_path).notes


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
    (tmp_path / "1.csv").write_text(recorded["1.csv"], "utf-16")
    with pytest.raises(RecordingError, match=r"1\.csv:1: it begins with a byte-order mark"):
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
        report = run_virtually(*options)[0]
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
    report = run_virtually(*options, "--latency", "0ms")[0]
    assert report["replay_deviation_cm"] < END_BOUND_CM
    assert report["problems"] == []


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings in {DATA}: set SWARM_THESIS_DATA to their folder")
def test_without_a_robot_another_algorithm_ends_elsewhere(tmp_path: Path) -> None:
    files = {name: (DATA / "localization" / "test_3" / name).read_text() for name in ("0.csv", "1.csv")}
    (problem,) = run_virtually("localization", "--replay", written(tmp_path, files), "--latency", "0ms")[0]["problems"]
    assert "a robot's file is missing" in problem


def test_the_command_ends_with_1(tmp_path: Path, recorded: dict[str, str]) -> None:
    place = written(tmp_path, {name: recorded[name] for name in ("0.csv", "1.csv")})
    command = [sys.executable, "-m", "laptop.cli", "sim", *THESIS, "--replay", place, "--virtual"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 1
    assert "problem     the replay leaves" in done.stdout
