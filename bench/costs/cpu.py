"""CPU time of one robot's bus, mesh and app for 100 lockstep iterations, read from /proc in mid-run.

All that those processes do in that time is in it: the links' heartbeats, the other services' messages on the bus, and
the app's state for whoever watches. With links over sockets a robot's mesh does what it does on a robot: TCP differs
from RFCOMM in how the socket is made, frames are authenticated, and the radio is a process apart
(`bench.rigs.tcp_radio`), whose time is not counted, as kernel and controller are on a robot. With simulated links a
mesh is its own radio, too.

A robot has its processors for itself. Where the processes of six share two cores, each finds others' data in the caches
whenever it wakes, and pays for that. So one robot is there with all its processes, and its neighbours (their meshes'
real cores and links, their locksteps) are one process, `bench.rigs.peers`; what it takes among six is told beside it.
"""

import os
import statistics
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from bench.rigs import one_sim
from bench.rigs.simulation import Simulation
from bench.rows import Row
from swarm.process.simulations import pid_file

NAMES = tuple(f"r{index}" for index in range(6))
SERVICES = ("bus", "mesh", "app/consensus")
LIMIT_S = 0.2
"""The thesis' one process takes 0.09 to 0.20 s for as much."""


class Kind(NamedTuple):
    """How robots are measured."""

    name: str
    program: tuple[str, ...]
    """What runs the simulation."""
    robots: tuple[str, ...]
    """Whose processes count."""


ONE = Kind("one robot", ("bench.rigs.one_sim",), (one_sim.ROBOT,))
KINDS = (
    ONE,
    Kind("six on two cores", ("bench.rigs.socket_sim",), NAMES),
    Kind("six on two cores, simulated links", ("laptop.cli", "sim"), NAMES),
)


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    topologies: tuple[str, ...] = ("line", "full")
    repeats: int = 3
    warm_up: int = 60
    iterations: int = 300


FULL = Sizes()
SMOKE = Sizes(("line",), 1, 5, 20)


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Measure; yields the rows of a topology as soon as it is measured, which takes three minutes in a quiet hour.
    Runs of all kinds take turns: the machine is not always the same."""
    for topology in sizes.topologies:
        found: dict[Kind, list[dict[str, float]]] = {kind: [] for kind in KINDS}
        for _ in range(sizes.repeats):
            for kind, runs in found.items():
                runs.append(measure(topology, kind, sizes))
        for kind, runs in found.items():
            goal = 1.0 if kind is ONE else None
            told = {service: [run[service] for run in runs] for service in SERVICES}
            told["the three"] = [sum(run.values()) for run in runs]
            for what, shares in told.items():
                name = f"{topology} 6, {kind.name}, {what}, a robot and 100 iterations"
                yield Row(name, statistics.median(shares), "s", LIMIT_S, goal)


def cpu_s(pid: int) -> float:
    """User and system time of all threads of a process so far, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(topology: str, kind: Kind, sizes: Sizes) -> dict[str, float]:
    """s by service, the mean of the robots that count."""
    options = ("--robots", str(len(NAMES)), "--topology", topology, "--seconds", "600")
    watched = kind.robots[0]
    with Simulation("consensus", *options, program=kind.program) as simulation:
        simulation.wait_for(watched, sizes.warm_up)
        pids = {
            service: [int(pid_file(simulation.run_dir, name, service).read_text()) for name in kind.robots]
            for service in SERVICES
        }
        before = {service: sum(map(cpu_s, each)) for service, each in pids.items()}
        first = simulation.trajectory(watched).last
        simulation.wait_for(watched, first + sizes.iterations)
        after = {service: sum(map(cpu_s, each)) for service, each in pids.items()}
        hundreds = (simulation.trajectory(watched).last - first) / 100
        return {service: (after[service] - before[service]) / len(kind.robots) / hundreds for service in SERVICES}
