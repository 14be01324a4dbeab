"""A large message over three hops of the thesis' bandwidth while lockstep runs on the same links."""

import contextlib
import math
import queue
import statistics
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bench.rigs.simulation import Simulation, SimulationError
from bench.rows import Row
from swarm import clock
from swarm.app.overlays import Overlays
from swarm.bus.zenoh_bus import Bus

LATENCY_S = 0.03
BANDWIDTH = 78_000.0
"""bytes/s in each direction of each link."""

GOODPUT_GOAL = 0.85
LOCKSTEP_GOAL = 1.6
WAIT_S = 120.0


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    size: int = 960_000
    """Bytes: the bus takes 983040, with the request around them."""

    warm_up: int = 60
    """Iterations until the links are up and the first figure is taken."""

    quiet: int = 200
    """Iterations of the quiet figure."""


FULL = Sizes()
SMOKE = Sizes(102_400, 10, 20)


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    for name, flooded in (("unicast r0 to r3", False), ("flood from r0", True)):
        goodput, quiet, busy = _transfer(flooded, sizes)
        # Ratios are value / limit, at most the goal: seconds a megabyte, beside what the bandwidth takes for it.
        yield Row(f"1 MB, 3 hops, lockstep beside: {name}", 1e6 / goodput, "s", 1e6 / BANDWIDTH, 1.0 / GOODPUT_GOAL)
        yield Row(f"lockstep meanwhile ({name})", busy, "s", quiet, LOCKSTEP_GOAL)


def _transfer(flooded: bool, sizes: Sizes) -> tuple[float, float, float]:
    """Goodput, bytes/s, and the median lockstep iteration before and meanwhile, s."""
    arguments = ("--robots", "4", "--topology", "line", "--latency", f"{LATENCY_S}s", "--bandwidth", "78kB")
    payload = bytes(range(256)) * (sizes.size // 256)
    with contextlib.ExitStack() as stack:
        simulation = stack.enter_context(Simulation("consensus", *arguments, "--iterations", "5000"))
        simulation.wait_for("r0", sizes.warm_up + sizes.quiet)
        overlays = {}
        arrivals: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
        for robot in ("r0", "r3"):
            bus = Bus.of(Path(simulation.run_dir) / robot)
            stack.callback(bus.close)
            overlays[robot] = Overlays(bus, robot, "bench")
        overlays["r3"].on_flood(lambda origin, data: arrivals.put((clock.now(), data)))
        overlays["r3"].on_message(lambda sender, data: arrivals.put((clock.now(), data)))
        overlays["r0"].send("r3", b"warm up").result(WAIT_S)
        arrivals.get(timeout=WAIT_S)
        began = clock.now()
        if flooded:
            overlays["r0"].flood(payload)
        else:
            overlays["r0"].send("r3", payload, timeout=WAIT_S)
        ended, data = arrivals.get(timeout=WAIT_S)
        if data != payload:
            raise SimulationError(f"{len(data)} bytes arrived, not the {len(payload)} that were sent")
        times = simulation.trajectory("r1").times
        quiet, busy = (_median(times, sizes.warm_up, *when) for when in ((-math.inf, began), (began, ended)))
    return len(payload) / (ended - began), quiet, busy


def _median(times: dict[int, float], first: int, start: float, end: float) -> float:
    """Median time of an iteration over windows of ten, since a line's iterations alternate."""
    window = 10
    within = sorted(k for k, t in times.items() if start <= t < end and k >= first)
    return statistics.median((times[k + window] - times[k]) / window for k in within if k + window in times)
