"""A service of one robot killed or stopped in mid-run: the same trajectory bit for bit, and what it cost in time.

Then a thousand random faults against six robots (random_faults.py), which takes half an hour.
"""

import math
import time
from collections.abc import Iterator

from bench import random_faults
from bench.rows import Row
from bench.simulation import Simulation
from swarm.recording.trajectory import Trajectory

NAMES = ("r0", "r1", "r2")
VICTIM = "r1"
"""The middle one of a line: both others depend on it."""
ITERATIONS = 200
FAULT_AT = 60
STOPPED_S = 2.0
RANDOM_FAULTS = 1000

RUN = ("consensus", "--robots", "3", "--iterations", str(ITERATIONS))

LONGEST_PAUSE_S = 3.0
"""Budget for the longest gap between two iterations: a link that dies without a word is noticed after 3 s."""


def rows() -> Iterator[Row]:
    """Run once undisturbed, then once for each fault."""
    with Simulation(*RUN) as simulation:
        simulation.finish()
        undisturbed = {name: simulation.trajectory(name) for name in NAMES}
    yield Row("undisturbed, longest pause", longest_pause(undisturbed), "s", LONGEST_PAUSE_S, 1.0)
    for service in ("bus", "mesh", "dwm", "balancer", "app"):
        paths = disturbed(service)
        yield Row(f"{service} killed, values that differ", differing(undisturbed, paths), "", 1.0, 0.0)
        yield Row(f"{service} killed, longest pause", longest_pause(paths), "s", LONGEST_PAUSE_S, 1.0)
    paths = disturbed("app", stop=True)
    yield Row(f"app stopped {STOPPED_S:g} s, values that differ", differing(undisturbed, paths), "", 1.0, 0.0)
    beyond = longest_pause(paths) - STOPPED_S
    yield Row(f"app stopped {STOPPED_S:g} s, pause beyond that", beyond, "s", LONGEST_PAUSE_S, 1.0)
    yield from random_faults.rows(RANDOM_FAULTS, seed=1)


def disturbed(service: str, *, stop: bool = False) -> dict[str, Trajectory]:
    """A run in which one service of the victim is killed (or stopped for a while) in the middle."""
    with Simulation(*RUN) as simulation:
        simulation.wait_for(VICTIM, FAULT_AT)
        if stop:
            simulation.kill(VICTIM, service, "STOP")
            time.sleep(STOPPED_S)
            simulation.kill(VICTIM, service, "CONT")
        else:
            simulation.kill(VICTIM, service)
        simulation.finish()
        return {name: simulation.trajectory(name) for name in NAMES}


def differing(expected: dict[str, Trajectory], found: dict[str, Trajectory]) -> float:
    """How many values of all robots and iterations are not equal to the bit; nan for a run that stopped short."""
    if any(path.last != ITERATIONS for path in found.values()):
        return math.nan
    return float(sum(path.rows[k] != found[name].rows.get(k) for name, path in expected.items() for k in path.rows))


def longest_pause(paths: dict[str, Trajectory]) -> float:
    """The longest time any robot spent in one iteration, s."""
    return max(later - path.times[k - 1] for path in paths.values() for k, later in path.times.items() if k >= 1)
