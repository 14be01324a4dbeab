"""Inside a machine: how long an iteration takes on the slot radio, and how much of the processor the radio takes.

Figures, not tests: bench/lockstep/lab.py."""

import json
import os
import statistics
import time
from pathlib import Path

import pytest
from conftest import Processes
from inside_swarm import NAMES, SHARE, Swarm

from lab.radio.remote import Radio
from lab.waiting import until
from swarm.recording.run import Run

ITERATIONS = 120
WARM_UP = 30


def processor_time(process: int) -> float:
    """s, of the user's programs and of the kernel's for them (proc(5))."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.mark.parametrize("config", ["line", "star", "full"])
def test_an_iteration_takes_as_long_as_the_radio_lets_it(processes: Processes, radio: Radio, config: str) -> None:
    until("no connection of a test before", lambda: not radio.order("look")["links"])
    swarm = Swarm(processes, config)
    swarm.run(ITERATIONS)
    swarm.wait_reached("the first iterations", WARM_UP)
    began, used = time.monotonic(), processor_time(radio.pid)
    swarm.wait_reached("the end of the run", ITERATIONS)
    share = (processor_time(radio.pid) - used) / (time.monotonic() - began)
    swarm.end()
    found = Run(swarm.records).trajectories("consensus")
    swarm.close()
    spans = [(found[name].times[ITERATIONS] - found[name].times[WARM_UP]) / (ITERATIONS - WARM_UP) for name in NAMES]
    with (SHARE / "pace").open("a") as file:
        file.write(json.dumps({"config": config, "iteration_s": statistics.median(spans), "radio": share}) + "\n")
