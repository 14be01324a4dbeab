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

from bench.radio_swarm import pace
from bench.rows import Row
from lab.inside import run_tests
from lab.shapes import config, star
from lab.vm.build import image
from lab.vm.machine import PLAIN, Machine
from swarm.config.keyfile import new_key_file

GOAL = 1.5

SIMULATED = {"line": ("line 6", "graph"), "star": ("loop 6", "star")}
"""Graph and links of each configuration."""

RADIO = "slots:host=0"
"""As the lab's controllers have it: the hosts' time is their own."""

ITERATIONS, SEEDS = 400, 5
"""Of the runs in virtual time."""


KEY = 'key = "/share/swarm.key"'


@dataclass(frozen=True)
class Sizes:
    """What the machine measures is decided in it (tests/lab/inside_pace.py)."""


FULL = SMOKE = Sizes()


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Boot, measure; six robots in line, and six in a loop over a hub."""
    with (
        tempfile.TemporaryDirectory() as folder,
        Machine(image(), Path(folder), "robots", init=PLAIN, memory_mb=1536) as machine,
    ):
        new_key_file(machine.share / "swarm.key", int(time.time()))
        for name, made in (("line", config("line", KEY)), ("star", star("loop", KEY))):
            (machine.share / f"{name}.toml").write_text(made)
        run_tests(machine, "tests/lab/inside_pace.py")
        lines = (machine.share / "pace").read_text().splitlines()
    for found in map(json.loads, lines):
        graph, links = SIMULATED[found["config"]]
        model = statistics.median(pace(graph, ITERATIONS, seed, links=links, radio=RADIO) for seed in range(SEEDS))
        yield Row(f"iteration, {graph}, links = {links}", found["iteration_s"], "s", model, GOAL)
