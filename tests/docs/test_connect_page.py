"""The programs of the pages about other tools run against a simulation and its recording."""

import importlib.util
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from bench.running import running

ROOT = Path(__file__).parents[2]
PAGES = ("how-to/tools/zenoh-client.md", "how-to/runs/export.md")
PROGRAM = re.compile(r"^```python (\S+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PROGRAMS = dict(PROGRAM.findall("".join((ROOT / "docs" / page).read_text(encoding="utf-8") for page in PAGES)))

pytestmark = [pytest.mark.slow, pytest.mark.timeout(200)]


@pytest.fixture
def simulation(tmp_path: Path) -> Iterator[Path]:
    """The folder of a simulation that runs."""
    words = ("sim", "consensus", "--robots", "2", "--seconds", "120", "--run-dir", tmp_path / "run")
    with running([sys.executable, "-m", "laptop.cli", *words], cwd=ROOT, stdout=subprocess.DEVNULL):
        yield tmp_path


def run_program(name: str, folder: Path, *arguments: object) -> str:
    path = folder / name
    path.write_text(PROGRAMS[name])
    words = [sys.executable, path, *map(str, arguments)]
    done = subprocess.run(words, check=False, capture_output=True, text=True, timeout=60)
    return done.stdout + done.stderr


def until_said(program: str, folder: Path, text: str, *arguments: object) -> None:
    """Run a program until it shows what it looks for: a simulation has to start."""
    for _ in range(100):
        if text in (shown := run_program(program, folder, *arguments)):
            return
    pytest.fail(f"{program} never showed {text}: {shown}")


def test_a_stock_zenoh_client_reads_an_apps_state(simulation: Path) -> None:
    until_said("client.py", simulation, "'value':", simulation / "run" / "r0" / "bus.sock", 3)


@pytest.mark.skipif(importlib.util.find_spec("pandas") is None, reason="pandas is not installed")
def test_pandas_reads_a_recording_through_the_makers_reader(tmp_path: Path) -> None:
    words = ("sim", "consensus", "--virtual", "--robots", "2", "--iterations", "5", "--record", tmp_path / "recorded")
    subprocess.run([sys.executable, "-m", "laptop.cli", *map(str, words)], check=True, cwd=ROOT, capture_output=True)
    (recording,) = (tmp_path / "recorded").rglob("*.mcap")
    assert "state.value" in run_program("table.py", tmp_path, recording)


def test_the_layout_for_foxglove_names_topics_that_are_served() -> None:
    from swarm.messages import type_of

    text = (ROOT / "examples" / "foxglove" / "layout.json").read_text()
    keys = set(re.findall(r"swarm/r\d/[a-z/]+", text))
    assert len(keys) >= 18
    assert all(type_of(key) is not None for key in keys)
    assert {"/scene", "/log"} <= set(re.findall(r'"(/[a-z]+)"', text))
