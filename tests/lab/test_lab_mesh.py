"""The mesh over real RFCOMM, six robots in one machine: tests/lab/inside_consensus.py."""

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from lab.inside import run_tests
from lab.shapes import ITERATIONS, SHAPES, config
from lab.vm.machine import PLAIN, Machine
from swarm.keyfile import new_key_file

pytest_plugins = ("lab_fixtures",)
pytestmark = [pytest.mark.lab, pytest.mark.timeout(900)]


def simulate(shape: str, share: Path) -> None:
    """The same swarm in the simulation of this host: its configuration and its recording, for the machine."""
    (share / f"{shape}.toml").write_text(config(shape, 'key = "/share/swarm.key"'))
    own = share / "own.toml"
    own.write_text(config(shape, "insecure = true"))
    words = ["consensus", "--config", str(own), "--virtual", "--iterations", str(ITERATIONS), "--json"]
    record = ["--record", str(share / "simulated" / shape)]
    subprocess.run([sys.executable, "-m", "services.sim", *words, *record], check=True, capture_output=True)


@pytest.fixture
def robots(machine: Callable[..., Machine]) -> Machine:
    made = machine("robots", init=PLAIN, cores=2, memory_mb=1536)
    made.start()
    return made


def test_six_robots_compute_what_the_simulation_computes(robots: Machine) -> None:
    new_key_file(robots.share / "swarm.key", int(time.time()))
    for shape in SHAPES:
        simulate(shape, robots.share)
    run_tests(robots, "tests/lab/inside_consensus.py", 800)
