"""Lockstep over the RFCOMM of a real kernel, in a machine of the lab, beside virtual time on the same slot radio.

All processes of six robots and their radio share the machine's one processor.
"""

import json
import statistics
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bench.radio.swarm import pace
from bench.rows import Row
from lab.inside import run_tests
from lab.shapes import config, star
from lab.vm.build import image
from lab.vm.machine import PLAIN, Machine
from swarm.config.keyfile import new_key_file

GOAL = 1.5
KEEPS_UP = 0.5
"""Of the machine's one processor, which all services share with the radio."""

SIMULATED = {"line": ("line 6", "graph"), "star": ("loop 6", "star"), "full": ("full 6", "graph")}
"""Graph and links of each configuration."""

RADIO = "slots:host=0"
"""As the lab's controllers have it: the hosts' time is their own."""

ITERATIONS, SEEDS = 200, 3
"""Of the runs in virtual time."""


KEY = 'key = "/share/swarm.key"'


@dataclass(frozen=True)
class Sizes:
    """What the machine measures is decided in it (tests/lab/inside/inside_pace.py)."""


FULL = SMOKE = Sizes()


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Boot, measure; six robots in line, in a loop over a hub, and in a full graph."""
    with (
        tempfile.TemporaryDirectory() as folder,
        Machine(image(), Path(folder), "robots", init=PLAIN, memory_mb=1536) as machine,
    ):
        new_key_file(machine.share / "swarm.key", int(time.time()))
        for name, made in (("line", config("line", KEY)), ("star", star("loop", KEY)), ("full", config("full", KEY))):
            (machine.share / f"{name}.toml").write_text(made)
        run_tests(machine, "tests/lab/inside/inside_pace.py")
        lines = (machine.share / "pace").read_text().splitlines()
    for found in map(json.loads, lines):
        graph, links = SIMULATED[found["config"]]
        model = statistics.median(pace(graph, ITERATIONS, seed, links=links, radio=RADIO) for seed in range(SEEDS))
        name = f"{graph}, links = {links}"
        yield Row(f"iteration, {name}", found["iteration_s"], "s", model, GOAL)
        yield Row(f"radio of all six, {name}", found["radio"], "cores", 1.0, KEEPS_UP)
