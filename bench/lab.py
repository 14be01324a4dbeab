"""Lockstep over the RFCOMM of a real kernel, in a machine of the lab, beside plain sockets of the same links.

The machine is alone: its clock counts its own instructions, 2 ns each, so a figure is what the links and the programs'
instructions take and nothing else. All processes of six robots and their radio share that one core of 500 million
instructions a second. By the host's clock the same is told, of which most is what emulation takes.
"""

import json
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from bench.rows import Row
from lab.inside import run_tests
from lab.shapes import config
from lab.vm.build import image
from lab.vm.machine import PLAIN, Machine
from swarm.keyfile import new_key_file

GOAL = 1.5


def rows() -> Iterator[Row]:
    """Boot, measure; six robots in line."""
    yield from _measured("", GOAL, "", alone=True)
    yield from _measured(", by the host's clock", None, "-k 0.03", alone=False)


def _measured(clock: str, goal: float | None, words: str, *, alone: bool) -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as folder:
        cores = 1 if alone else 2
        machine = Machine(
            image(), Path(folder) / "robots", "robots", init=PLAIN, cores=cores, memory_mb=1536, alone=alone
        )
        with machine:
            new_key_file(machine.share / "swarm.key", int(time.time()))
            (machine.share / "line.toml").write_text(config("line", 'key = "/share/swarm.key"'))
            run_tests(machine, f"tests/lab/inside_pace.py {words}", 600)
            lines = (machine.share / "pace").read_text().splitlines()
    for found in map(json.loads, lines):
        name = f"iteration, line of 6, RFCOMM, {1000 * found['latency_s']:.0f} ms links{clock}"
        yield Row(name, found["iteration_s"], "s", found["one_way_s"], goal)
