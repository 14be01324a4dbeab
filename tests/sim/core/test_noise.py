"""The thesis' simulation study: its error model, its scenario, its figure."""

import json
import math
import random
import subprocess
import sys
from pathlib import Path

import pytest

from sim.core import noise
from sim.scenario import options, scenario
from swarm.errors import ConfigError
from swarm.recording.thesis_ranges import read_folder

PLACES = {"r0": (0.5, 1.5), "r1": (1.0, 0.5), "r2": (1.5, 1.5)}
TARGET = (0.5, 1.0)


def made(model: str, rows: int = 50, seed: int = 1) -> dict:
    return noise.noisy_recordings(model, PLACES, TARGET, rows, random.Random(seed))


def test_without_noise_it_is_exact() -> None:
    for name, recording in made("none").items():
        assert set(recording.rows) == {(math.dist(PLACES[name], TARGET), *PLACES[name])}


def test_a_bias_is_drawn_once_and_holds() -> None:
    shares = []
    for seed in range(200):
        for name, recording in made("bias", 12, seed).items():
            (row,) = set(recording.rows)
            true = (math.dist(PLACES[name], TARGET), *PLACES[name])
            shares += [value / exact - 1 for value, exact in zip(row, true, strict=True)]
    assert max(map(abs, shares)) <= 0.05
    assert max(shares) > 0.0495
    assert min(shares) < -0.0495
    # Uniform: its standard deviation is its half width by the root of three.
    assert math.sqrt(sum(s * s for s in shares) / len(shares)) == pytest.approx(0.05 / math.sqrt(3), rel=0.05)


def test_two_models_have_the_same_biases() -> None:
    for biased, noisy in zip(made("bias").values(), made("thesis").values(), strict=True):
        for values in zip(biased.rows, noisy.rows, strict=True):
            for held, seen in zip(*values, strict=True):
                assert abs(seen / held - 1) <= 0.02


def test_noise_is_drawn_every_five_iterations() -> None:
    for recording in made("thesis").values():
        changes = [k for k in range(1, 50) if recording.rows[k] != recording.rows[k - 1]]
        assert changes == list(range(5, 50, 5))
        for values in zip(*recording.rows, strict=True):
            assert (max(values) - min(values)) / min(values) < 0.041


def test_made_measurements_can_be_written_and_replayed(tmp_path: Path) -> None:
    recordings = made("thesis")
    for index, recording in enumerate(recordings.values()):
        (tmp_path / f"{index}.csv").write_text(noise.as_csv(recording))
    for read, recording in zip(read_folder(tmp_path), recordings.values(), strict=True):
        assert read.times == recording.times
        assert [tuple(row) for row in read.rows] == [pytest.approx(tuple(row), abs=1e-15) for row in recording.rows]


def build(tmp_path: Path, *arguments: str) -> scenario.Scenario:
    return scenario.build(options.parse(["localization", *arguments]), tmp_path)


def test_the_scenario_replays_what_was_made_up(tmp_path: Path) -> None:
    plan = build(tmp_path, "--noise", "thesis", "--iterations", "30", "--algorithm", "thesis")
    assert plan.synthetic
    assert plan.recorded == {}
    assert plan.config.dwm.source == f"replay:{tmp_path / 'noise'}"
    assert [recording.steps for recording in read_folder(tmp_path / "noise")] == [30, 30, 30]
    again = build(Path("/virtual"), "--noise", "thesis", "--iterations", "30", "--algorithm", "thesis")
    assert [r.rows for r in again.recordings.values()] == [r.rows for r in plan.recordings.values()]
    other = build(Path("/virtual"), "--noise", "thesis", "--iterations", "30", "--seed", "2")
    assert [r.rows for r in other.recordings.values()] != [r.rows for r in plan.recordings.values()]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["localization", "--noise", "thesis", "--replay", "x"], "leave out one of them"),
        (["--noise", "thesis"], "--noise needs an APP"),
    ],
)
def test_what_makes_no_sense_is_refused(arguments: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        options.parse(arguments)


def test_the_study_runs_in_virtual_time() -> None:
    """Figure 4.9 (d): errors of some cm that do not go away."""
    command = [sys.executable, "-m", "laptop.cli.runs.sim", "localization", "--virtual", "--noise", "thesis", "--json"]
    command += ["--algorithm", "thesis", "--step-size", "4e-6", "--iterations", "120", "--seed", "3"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["iterations"] == 120
    assert 0.2 < report["error_cm"] < 15
    assert "recorded_error_cm" not in report
