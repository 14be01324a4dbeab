"""The mesh over real RFCOMM, six robots in one machine: tests/lab/inside/inside_consensus.py and inside_overlays.py."""

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from lab import waiting
from lab.inside import run_tests
from lab.shapes import ENDLESS, ITERATIONS, LONG, auto, config, star
from lab.vm.build import Image
from lab.vm.machine import PLAIN, Machine
from swarm.config.keyfile import new_key_file

pytest_plugins = ("lab_fixtures",)
pytestmark = [pytest.mark.lab, pytest.mark.timeout(1300)]

RULES = """
[[relay]]
keys = "swarm/{self}/dwm/pose"
overlay = "flood"
[[relay]]
keys = "swarm/{peer}/balancer/set/leds"
overlay = "unicast"
priority = "sync"
"""


def simulate(shape: str, share: Path, make: Callable[[str, str], str] = config, name: str = "") -> None:
    """The same swarm in the simulation of this host: its configuration as `make` has it, and its recording, for the
    machine, named after its shape if not otherwise."""
    name = name or shape
    if (share / "simulated" / name).exists():
        return
    (share / f"{name}.toml").write_text(make(shape, 'key = "/share/swarm.key"'))
    own = share / "own.toml"
    own.write_text(make(shape, "insecure = true"))
    iterations = {"line": LONG, "around": ENDLESS}.get(name, ITERATIONS)
    words = ["consensus", "--config", str(own), "--virtual", "--iterations", str(iterations), "--json"]
    record = ["--record", str(share / "simulated" / name)]
    waiting.run(f"the simulation of {name}", [sys.executable, "-m", "laptop.cli.runs.sim", *words, *record])


@pytest.fixture(scope="module")
def robots(lab_image: Image, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    with Machine(lab_image, tmp_path_factory.mktemp("mesh"), "robots", init=PLAIN, memory_mb=1536) as made:
        for name in ("swarm", "stranger"):
            new_key_file(made.share / f"{name}.key", int(time.time()))
        yield made


@pytest.mark.parametrize("shapes", ["line", "loop or random or full"])
def test_six_robots_compute_what_the_simulation_computes(robots: Machine, shapes: str) -> None:
    for shape in shapes.split(" or "):
        simulate(shape, robots.share)
    run_tests(robots, f"tests/lab/inside/inside_consensus.py -k 'simulation and ({shapes})'")


def test_a_hub_carries_the_graph_and_is_central_of_all(robots: Machine) -> None:
    simulate("loop", robots.share, star, "star")
    simulate("random", robots.share, auto, "auto")
    run_tests(robots, "tests/lab/inside/inside_consensus.py -k hub")


def test_nothing_is_lost_or_doubled_by_faults_in_mid_run(robots: Machine) -> None:
    simulate("line", robots.share)
    run_tests(robots, "tests/lab/inside/inside_consensus.py -k faults")


def test_a_silent_link_is_gone_around(robots: Machine) -> None:
    simulate("loop", robots.share, config, "around")
    run_tests(robots, "tests/lab/inside/inside_consensus.py -k around")


def test_all_that_the_mesh_does_it_does_over_rfcomm(robots: Machine) -> None:
    (robots.share / "overlays.toml").write_text(config("loop", 'key = "/share/swarm.key"', RULES))
    for name in ("swarm", "stranger"):
        (robots.share / f"{name}.toml").write_text(config("line", f'key = "/share/{name}.key"'))
    run_tests(robots, " ".join(f"tests/lab/inside/inside_{name}.py" for name in ("overlays", "stranger", "pybluez")))
