"""Lockstep over the RFCOMM of a real kernel, in a machine of the lab, beside plain sockets of the same links.

All processes of six robots and their radio share the machine's one processor.
"""

import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bench.rows import Row
from lab.inside import run_tests
from lab.shapes import config
from lab.vm.build import image
from lab.vm.machine import PLAIN, Machine
from swarm.config.keyfile import new_key_file

GOAL = 1.5


@dataclass(frozen=True)
class Sizes:
    """What the machine measures is decided in it (tests/lab/inside_pace.py)."""


FULL = SMOKE = Sizes()


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Boot, measure; six robots in line."""
    with (
        tempfile.TemporaryDirectory() as folder,
        Machine(image(), Path(folder), "robots", init=PLAIN, memory_mb=1536) as machine,
    ):
        new_key_file(machine.share / "swarm.key", int(time.time()))
        (machine.share / "line.toml").write_text(config("line", 'key = "/share/swarm.key"'))
        run_tests(machine, "tests/lab/inside_pace.py")
        lines = (machine.share / "pace").read_text().splitlines()
    for found in map(json.loads, lines):
        name = f"iteration, line of 6, RFCOMM, {1000 * found['latency_s']:.0f} ms links"
        yield Row(name, found["iteration_s"], "s", found["one_way_s"], GOAL)
