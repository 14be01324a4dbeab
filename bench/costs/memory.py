"""How fast the processes of two simulated robots grow, and `swarm sim` itself: MB an hour, by a straight line through
their memory after a warm-up.

What counts is what no file stands behind (anonymous memory): the rest can be dropped and read again at any time. A
warm-up of as long as is measured, an hour at most, goes before: interpreter and allocator fill their free lists in it.
"""

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.rigs.simulation import Simulation
from bench.rows import Row
from swarm.process.simulations import pid_file

ROBOTS = ("r0", "r1")
APP = "app/localization"
SERVICES = ("bus", "mesh", "balancer", "dwm", APP)
LONGEST_WARM_UP_S = 3600.0
FIRST_ITERATION = 10
LIMIT_MB_H = 0.2
LOOKS = 120
"""Spread over the time that is measured."""
ZENOH = "C heap, filled by Zenoh"

Samples = dict[str, list[tuple[float, float]]]
"""By process: time in h, memory in MB."""


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    seconds: float = 3600.0
    """How long is measured."""


FULL = Sizes()
SMOKE = Sizes(15.0)


def rows(sizes: Sizes) -> Iterator[Row]:
    """Measure after a warm-up of the same length, an hour at most. A router's heap is given
    beside its whole memory: what that grows by is Zenoh's own, Python's objects lie elsewhere."""
    seconds = sizes.seconds
    warm_up = min(seconds, LONGEST_WARM_UP_S)
    lasts = warm_up + seconds + 600.0
    with Simulation("localization", "--robots", str(len(ROBOTS)), "--seconds", f"{lasts:.0f}") as simulation:
        for robot in ROBOTS:
            simulation.wait_for(robot, FIRST_ITERATION, "localization")
        time.sleep(warm_up)
        pids = _pids(simulation)
        found: Samples = {name: [] for name in [*pids, *(f"{robot} bus, {ZENOH}" for robot in ROBOTS)]}
        began = time.monotonic()
        while (after := time.monotonic() - began) <= seconds:
            _look(found, pids, after / 3600)
            time.sleep(seconds / LOOKS)
        restarted = pids != _pids(simulation)
    for name, samples in found.items():
        growth = math.nan if restarted else slope(samples)
        # It may shrink; what is judged is that it does not grow.
        yield Row(f"{name}, growth", growth, "MB/h", LIMIT_MB_H, None if ZENOH in name else 1.0)


def slope(samples: Sequence[tuple[float, float]]) -> float:
    """Of the straight line through (x, y) with the least squares; nan where there are less than two."""
    if len(samples) < 2:
        return math.nan
    x_mean = math.fsum(x for x, _ in samples) / len(samples)
    y_mean = math.fsum(y for _, y in samples) / len(samples)
    square = math.fsum((x - x_mean) ** 2 for x, _ in samples)
    return math.fsum((x - x_mean) * (y - y_mean) for x, y in samples) / square


def _pids(simulation: Simulation) -> dict[str, int]:
    pids = {"swarm sim": simulation.process.pid}
    for robot in ROBOTS:
        for service in SERVICES:
            pids[f"{robot} {service}"] = int(pid_file(simulation.run_dir, robot, service).read_text())
        loop = pids[f"{robot} balancer"]
        pids[f"{robot} balancer, bridge"] = int(Path(f"/proc/{loop}/task/{loop}/children").read_text().split()[0])
    return pids


def _look(found: Samples, pids: Mapping[str, int], hours: float) -> None:
    for name, pid in pids.items():
        try:
            parts = anonymous_mb(Path(f"/proc/{pid}/smaps").read_text())
        except OSError:
            continue  # it has ended; whoever asks for the pids again sees that
        found[name].append((hours, math.fsum(parts.values())))
        if f"{name}, {ZENOH}" in found:
            found[f"{name}, {ZENOH}"].append((hours, parts.get("[heap]", 0.0)))


def anonymous_mb(smaps: str) -> dict[str, float]:
    """Anonymous memory by what is mapped, MB; all that has no name is under the empty one (proc(5), smaps)."""
    found: dict[str, float] = {}
    name = ""
    for line in smaps.splitlines():
        words = line.split()
        if not words[0].endswith(":"):
            name = words[5] if len(words) > 5 else ""
        elif words[0] == "Anonymous:":
            found[name] = found.get(name, 0.0) + int(words[1]) * 1024 / 1e6
    return found
