"""CPU time of each process of one robot for a second of a run: three robots, 30 ms links, lockstep and UWB at 10 Hz.

Beside it a tenth of a core: a Pi Zero 2 W has four, some eight times slower than one of this machine's.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bench.costs.cpu import cpu_s
from bench.rigs.simulation import Simulation
from bench.rows import Row
from swarm.process.simulations import pid_file

ROBOT = "r0"
SERVICES = ("bus", "mesh", "balancer", "dwm", "app/localization")
LIMIT_S = 0.1


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    warm_up: int = 60
    seconds: float = 10.0


FULL = Sizes()
SMOKE = Sizes(5, 1.0)


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """The balancer's processes are two: the loop (with the simulated body in it) and the bridge."""
    with Simulation("localization", "--robots", "3", "--seconds", "600") as simulation:
        simulation.wait_for(ROBOT, sizes.warm_up, "localization")
        pids = {name: int(pid_file(simulation.run_dir, ROBOT, name).read_text()) for name in SERVICES}
        pids["balancer, bridge"] = _child(pids["balancer"])
        before = {name: cpu_s(pid) for name, pid in pids.items()}
        began = time.monotonic()
        time.sleep(sizes.seconds)
        spent = {name: (cpu_s(pid) - before[name]) / (time.monotonic() - began) for name, pid in pids.items()}
    for name, share in spent.items():
        yield Row(f"{name}, a second of a run", share, "s", LIMIT_S, 1.0)
    yield Row("all of a robot's, a second of a run", sum(spent.values()), "s", len(spent) * LIMIT_S, 1.0)


def _child(pid: int) -> int:
    return int(Path(f"/proc/{pid}/task/{pid}/children").read_text().split()[0])
