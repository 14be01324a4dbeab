"""Virtual time, checks, plots and sweeps run where a system lacks what only Linux has; the rest says what it needs."""

import os
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from bench.rigs.running import running

PROGRAM = Path(__file__).parent / "other_systems.py"
ROOT = Path(__file__).parents[2]

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]


def bare_environment() -> dict[str, str]:
    environment = {name: value for name, value in os.environ.items() if name != "XDG_RUNTIME_DIR"}
    return environment | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}


@pytest.fixture(params=["windows", "macos"])
def system(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def on_another_system(folder: Path, system: str, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(PROGRAM), system, *words]
    return subprocess.run(command, cwd=folder, env=bare_environment(), capture_output=True, text=True, timeout=240)


@contextmanager
def served_on_another_system(folder: Path, system: str, *words: str) -> Iterator[str]:
    """The address that a command tells when it serves."""
    command = [sys.executable, str(PROGRAM), system, *words]
    with running(command, cwd=folder, env=bare_environment(), stdout=subprocess.PIPE, text=True) as process:
        yield process.stdout.readline().strip()


def test_a_run_from_python_is_simulated_saved_and_loaded(tmp_path: Path, system: str) -> None:
    done = on_another_system(tmp_path, system)
    assert done.returncode == 0, done.stderr


def test_an_author_writes_checks_simulates_plots_and_exports(tmp_path: Path, system: str) -> None:
    for words in (
        "new mine.py",
        "check mine.py",
        "sim mine.py --virtual --robots 4 --iterations 30 --record runs/mine --plot mine.png",
        "plot runs/mine -o plot.png",
        "export runs/mine --table tables",
        "sweep consensus --robots 4 --topology line,loop --seeds 1",
        "config --example",
        "view --help",
        "key new swarm.key",
    ):
        done = on_another_system(tmp_path, system, *words.split())
        assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"
    assert (tmp_path / "mine.png").stat().st_size > 5000


def test_the_live_page_shows_a_recording_and_a_run_under_virtual_time(tmp_path: Path, system: str) -> None:
    run = "sim consensus --virtual --robots 3 --iterations 30"
    assert on_another_system(tmp_path, system, *run.split(), "--record", "run").returncode == 0
    for words in ("view run --no-open", f"{run} --view --no-open"):
        with (
            served_on_another_system(tmp_path, system, *words.split()) as address,
            urllib.request.urlopen(address) as answer,
        ):
            assert b"<html" in answer.read()


PROCESSES = ("sim consensus --robots 3 --seconds 2", "sim consensus --robots 3 --run-dir rig", "demo")
"""Commands that start the processes of robots."""
UNIX = ("estop", "view --no-open", "film run film.webp", "flash x.hex --port auto", "drive r0", "calibrate fit")
"""Commands that need what only Unix has."""


@pytest.mark.parametrize(
    ("system", "words"),
    [*(("windows", each) for each in (*PROCESSES, *UNIX, "commission r0")), *(("macos", each) for each in PROCESSES)],
)
def test_what_needs_processes_says_so(tmp_path: Path, system: str, words: str) -> None:
    done = on_another_system(tmp_path, system, *words.split())
    assert done.returncode == 2
    assert "need Linux (on Windows: WSL)" in done.stderr or "needs Linux (on Windows: WSL)" in done.stderr, done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("words", ["estop", "view --no-open", "drive r0", "status", "kill r0 mesh", "flash x.hex"])
def test_what_finds_no_robots_on_macos_says_so_in_a_line(tmp_path: Path, words: str) -> None:
    done = on_another_system(tmp_path, "macos", *words.split())
    assert done.returncode == 2
    assert done.stderr.startswith("swarm: ")
    assert done.stderr.count("\n") == 1, done.stderr
