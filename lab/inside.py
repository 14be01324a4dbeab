"""Pytest inside a machine: this checkout's tests on the installed release."""

import shutil
import sys
from pathlib import Path

from lab.vm.machine import Machine

ROOT = Path(__file__).parents[1]

PATIENCE = 6
"""How many times longer than elsewhere a test of the services may wait inside a machine: all have one processor."""

PYTHON = "/opt/swarm/current/bin/python"
"""Inside: the release's."""

INI = """[pytest]
markers =
  slow
  lab
addopts = --strict-markers
"""


def furnish(machine: Machine) -> None:
    """Put the tests and the lab's tools into the machine's /share; the project itself is the installed release."""
    for name in ("lab", "tests/conftest.py", "tests/lab"):
        source, target = ROOT / name, machine.share / name
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
        else:
            target.parent.mkdir(exist_ok=True)
            shutil.copy(source, target)
    (machine.share / "pytest.ini").write_text(INI)


def command(words: str) -> str:
    """The shell command that runs the release's Python inside with these words."""
    environment = f"PYTHONPATH=/share:/share/tests:/share/tests/lab LAB_PATIENCE={PATIENCE} PYTHONUNBUFFERED=1"
    return f"cd /share && {environment} {PYTHON} {words}"


def run_tests(machine: Machine, words: str, seconds: float) -> str:
    """Run pytest inside with these words, with six adapters of its kernel: what it said. AssertionError if it fails."""
    furnish(machine)
    options = "-p no:cacheprovider -p inside_radio -v -s --durations=20 --tb=short --timeout=300"
    # Into a file of the host, too, for whoever wants to see how far it is.
    log = "/share/pytest.log"
    words = f"{command(f'-m pytest {options} {words}')} >{log} 2>&1; code=$?; cat {log}; exit $code"
    result = machine.wait(machine.spawn(words, seconds), seconds + 30)
    sys.stdout.write(result.output)
    assert result.code == 0, f"exit code {result.code}: {result.output[-8000:]}"
    return result.output
