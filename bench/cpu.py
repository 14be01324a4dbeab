"""CPU time of one robot's bus, mesh and app for 100 lockstep iterations, read from /proc in mid-run.

All that those processes do in that time is in it: the links' heartbeats, the other services' messages on the bus, and
the app's state for whoever watches. With simulated links a robot's mesh is its own radio, too. With links over sockets
it does what it does on a robot: TCP differs from RFCOMM in how the socket is made, frames are authenticated, and the
radio is a process apart (`bench.radio`), whose time is not counted, as kernel and controller are on a robot.
"""

import os
import statistics
from collections.abc import Iterator
from pathlib import Path

from bench.rows import Row
from bench.simulation import Simulation
from swarm.simulations import pid_file

NAMES = tuple(f"r{index}" for index in range(6))
SERVICES = ("bus", "mesh", "app/consensus")
LIMIT_S = 0.2
"""The thesis' one process takes 0.09 to 0.20 s for as much."""

LINKS = {"sockets": ("bench.socket_sim",), "simulated links": ("swarm.cli", "sim")}
"""What runs the simulation, by kind of links."""

REPEATS = 3
WARM_UP = 60
ITERATIONS = 300


def rows() -> Iterator[Row]:
    """Measure; yields rows as they are there. Runs of all kinds take turns: the machine is not always the same."""
    kinds = [(topology, links) for topology in ("line", "full") for links in LINKS]
    found: dict[tuple[str, str], list[dict[str, float]]] = {kind: [] for kind in kinds}
    for _ in range(REPEATS):
        for kind, runs in found.items():
            runs.append(_measure(*kind))
    for (topology, links), runs in found.items():
        for service in SERVICES:
            share = statistics.median(run[service] for run in runs)
            yield Row(f"{topology} 6, {links}, {service}, a robot and 100 iterations", share, "s", LIMIT_S, 1.0)
        total = statistics.median(sum(run.values()) for run in runs)
        yield Row(f"{topology} 6, {links}, the three, a robot and 100 iterations", total, "s", LIMIT_S, 1.0)


def cpu_s(pid: int) -> float:
    """User and system time of all threads of a process so far, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(") ")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _measure(topology: str, links: str) -> dict[str, float]:
    """s by service, the mean of all robots."""
    options = ("--robots", str(len(NAMES)), "--topology", topology, "--seconds", "600")
    with Simulation("consensus", *options, program=LINKS[links]) as simulation:
        simulation.wait_for("r0", WARM_UP)
        pids = {
            service: [int(pid_file(simulation.run_dir, name, service).read_text()) for name in NAMES]
            for service in SERVICES
        }
        before = {service: sum(map(cpu_s, each)) for service, each in pids.items()}
        first = simulation.trajectory("r0").last
        simulation.wait_for("r0", first + ITERATIONS)
        after = {service: sum(map(cpu_s, each)) for service, each in pids.items()}
        hundreds = (simulation.trajectory("r0").last - first) / 100
        return {service: (after[service] - before[service]) / len(NAMES) / hundreds for service in SERVICES}
