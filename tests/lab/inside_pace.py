"""Inside a machine: how long an iteration takes on the slot radio. A figure, not a test: bench/lab.py."""

import json
import statistics

import pytest
from conftest import Processes
from inside_swarm import NAMES, SHARE, Swarm

from lab.radio.remote import Radio
from lab.waiting import until
from swarm.recording.run import Run

ITERATIONS = 120
WARM_UP = 30


@pytest.mark.parametrize("config", ["line", "star"])
def test_an_iteration_takes_as_long_as_the_radio_lets_it(processes: Processes, radio: Radio, config: str) -> None:
    until("no connection of a test before", lambda: not radio.order("look")["links"])
    swarm = Swarm(processes, config)
    swarm.run(ITERATIONS)
    swarm.wait_reached("the end of the run", ITERATIONS)
    swarm.end()
    found = Run(swarm.records).trajectories("consensus")
    swarm.close()
    spans = [(found[name].times[ITERATIONS] - found[name].times[WARM_UP]) / (ITERATIONS - WARM_UP) for name in NAMES]
    with (SHARE / "pace").open("a") as file:
        file.write(json.dumps({"config": config, "iteration_s": statistics.median(spans)}) + "\n")
