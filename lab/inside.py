"""Pytest inside a machine: this checkout's tests on the installed release."""

import shutil
import sys
from pathlib import Path

from lab.vm.machine import Machine

ROOT = Path(__file__).parents[1]

PYTHON = "/opt/swarm/current/bin/python"
"""Inside: the release's."""

INI = """[pytest]
markers =
  slow
  lab
addopts = --strict-markers
"""


def furnish(machine: Machine) -> None:
    """Put the tests, the lab's tools and what robots do not carry into the machine's /share."""
    for name in ("lab", "sim", "laptop", "bench/rigs/running.py", "tests/conftest.py", "tests/lab"):
        source, target = ROOT / name, machine.share / name
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
        else:
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target)
    (machine.share / "pytest.ini").write_text(INI)


def command(words: str) -> str:
    """The shell command that runs the release's Python inside with these words."""
    environment = "PYTHONPATH=/share:/share/tests:/share/tests/lab/inside PYTHONUNBUFFERED=1"
    return f"cd /share && {environment} {PYTHON} {words}"


def run_tests(machine: Machine, words: str, seconds: float = 900.0) -> str:
    """Run pytest inside with these words, with six adapters of its kernel: what it said. AssertionError if it fails."""
    furnish(machine)
    # A test inside ends later than its own waits (lab.waiting.PATIENCE_S), which say what they have waited for in vain.
    options = "-p no:cacheprovider -p inside_radio -v -s --durations=20 --tb=short --timeout=700"
    output = run_logged(machine, f"pytest inside: {words}", command(f"-m pytest {options} {words}"), seconds)
    sys.stdout.write(output)
    return output


def run_logged(machine: Machine, what: str, words: str, seconds: float) -> str:
    """Run a long shell command inside and return its output; its exit code must be 0. The output goes to a file in the
    machine's share, so that a long wait shows how far the command is."""
    log = machine.share / "command.log"
    log.write_text("")

    def last_line() -> str:
        return log.read_text(errors="replace").strip().rpartition("\n")[2]

    number = machine.spawn(f"({words}) >/share/{log.name} 2>&1", seconds)
    code = machine.wait(number, seconds + 30, what, last_line).code
    output = log.read_text(errors="replace")
    assert code == 0, f"{machine.name}: {what}: exit code {code}: {output[-30000:]}"
    return output
