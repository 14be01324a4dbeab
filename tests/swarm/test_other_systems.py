"""Virtual time, checks, plots and sweeps run where a system lacks what only Linux has; the rest says what it needs."""

import os
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from bench.running import running

PROGRAM = Path(__file__).parent / "other_systems.py"
ROOT = Path(__file__).parents[2]

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]


def bare_environment() -> dict[str, str]:
    environment = {name: value for name, value in os.environ.items() if name != "XDG_RUNTIME_DIR"}
    return environment | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"}


def on_another_system(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(PROGRAM), *words]
    return subprocess.run(command, cwd=folder, env=bare_environment(), capture_output=True, text=True, timeout=100)


@contextmanager
def served_on_another_system(folder: Path, *words: str) -> Iterator[str]:
    """The address of the page that a command serves."""
    command = [sys.executable, str(PROGRAM), *words]
    with running(command, cwd=folder, env=bare_environment(), stdout=subprocess.PIPE, text=True) as process:
        yield process.stdout.readline().strip()


def test_a_run_from_python_is_simulated_saved_and_loaded(tmp_path: Path) -> None:
    done = on_another_system(tmp_path)
    assert done.returncode == 0, done.stderr


def test_an_author_writes_checks_simulates_plots_and_exports(tmp_path: Path) -> None:
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
        done = on_another_system(tmp_path, *words.split())
        assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"
    assert (tmp_path / "mine.png").stat().st_size > 5000


def test_the_live_page_shows_a_recording_and_a_run_under_virtual_time(tmp_path: Path) -> None:
    run = "sim consensus --virtual --robots 3 --iterations 30"
    assert on_another_system(tmp_path, *run.split(), "--record", "run").returncode == 0
    for words in ("view run --no-open", f"{run} --view --no-open"):
        with served_on_another_system(tmp_path, *words.split()) as address, urllib.request.urlopen(address) as answer:
            assert b"<html" in answer.read()


@pytest.mark.parametrize(
    "words",
    [
        "sim consensus --robots 3 --seconds 2", "estop", "view --no-open", "film run film.webp", "flash x.hex",
        "drive r0", "calibrate fit", "commission r0",
    ],
)  # fmt: skip
def test_what_needs_processes_says_so(tmp_path: Path, words: str) -> None:
    done = on_another_system(tmp_path, *words.split())
    assert done.returncode == 2
    assert "need Linux" in done.stderr or "needs Linux" in done.stderr, done.stderr
    assert "Traceback" not in done.stderr
