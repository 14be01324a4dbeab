"""All robots switched on at once: how long beyond the time that a radio takes to connect until all links are up."""

import itertools
import queue
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass

from bench.mesh.mesh import LATENCY_S, WAIT_S, Swarm, line
from bench.rows import Row
from swarm import clock
from swarm.messages import Links
from swarm.messages.codec import decode

DIALS_S = (0.0, 2.0)
"""Without any, what counts is when the last attempt before the other robot's mesh was there is repeated. A Bluetooth
page takes 1.3 to 2.6 s where both ends are well; the thesis' robots needed 6.5 to 46 s for all links."""

LIMIT_S = 1.0
POLL_S = 0.005


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    robots: int = 6
    dials: tuple[float, ...] = DIALS_S
    repeats: int = 3


FULL = Sizes()
SMOKE = Sizes(3, (0.0,), 1)


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    count = sizes.robots
    for name, edges in (("line", line(count)), ("full", list(itertools.combinations(range(count), 2)))):
        for dial in sizes.dials:
            taken = statistics.median(_start(edges, dial) for _ in range(sizes.repeats))
            yield Row(f"all links up, {name} {count}, beyond {dial:g} s to dial", taken, "s", LIMIT_S, 1.0)


def _start(edges: list[tuple[int, int]], dial: float) -> float:
    """s from the moment the last mesh runs to the last link, without the dial."""
    up: queue.SimpleQueue[tuple[float, str, str]] = queue.SimpleQueue()

    def told(key: str, payload: bytes) -> None:
        now, links = clock.now(), decode(Links, payload, key)
        for link in links.links:
            if link.state == "up":
                up.put((now, key, link.peer))

    with Swarm(edges, f"latency={LATENCY_S},dial={dial}", wait=False) as swarm:
        for name, bus in swarm.buses.items():
            bus.subscribe(f"swarm/{name}/mesh/links", told)
        while not swarm.runs():
            time.sleep(POLL_S)
        running = clock.now()
        seen: dict[tuple[str, str], float] = {}
        while len(seen) < 2 * len(edges):
            now, key, peer = up.get(timeout=WAIT_S)
            seen.setdefault((key, peer), now)
        return max(seen.values()) - running - dial
