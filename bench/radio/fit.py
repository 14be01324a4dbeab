"""The slot radio beside the thesis' recordings: round trips, iterations, starts. What is not matched has its ratio."""

import csv
import statistics
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from random import Random
from typing import NamedTuple

from bench.radio.patterns import Edges, Original, pace, round_trips
from bench.rows import Row
from sim.slots.calls import Calls
from sim.slots.devices import RadioLink
from sim.slots.parameters import THESIS
from sim.slots.radio import SlotRadio
from sim.virtual.events import EventQueue
from swarm.core.graph import Graph

LOCK = 0.012
"""s that a message of the round-trip test waits for the interpreter at each end. Fitted."""

MARCH, MAY = (0.01, 0.005), (0.1, 0.06)
"""Sleep while something lacks, and the longest wait for the interpreter, s: the programs of March and April, and those
of May with display, LEDs and logging beside them. The first by the original's history, the second fitted."""

AGAIN = 5.0
"""s until the original calls again, give or take half of it."""
SLEEPS = (1.0, 2.0)
"""s that its programs sleep between their links and their first message."""


class Recorded(NamedTuple):
    """One recorded run."""

    folder: str
    shape: str
    order: str
    """Robots by Bluetooth address: the lower one calls."""
    delay: float
    """DELAY of the program, s, which it sleeps twice an iteration."""
    program: tuple[float, float]

    def links(self) -> Edges:
        """Callers first."""
        graph = Graph.of_shape(self.shape, sorted(self.order))
        return [(a, b) if self.order.index(a) < self.order.index(b) else (b, a) for a, b in graph.edges]


RUNS = (
    Recorded("consensus/line_3", "line", "120", 0.0, MAY),
    Recorded("consensus/line_3_rec", "line", "120", 0.1, MAY),
    Recorded("consensus/line_6", "line", "120345", 0.5, MAY),
    Recorded("consensus/loop_6", "loop", "120345", 1.5, MAY),
    Recorded("consensus/random_6", "thesis-d", "120345", 1.5, MAY),
    Recorded("consensus/old_line_8", "line", "12035647", 0.0, MARCH),
    Recorded("localization/simulated_measures_loop5_delay0.1", "loop", "20413", 0.1, MARCH),
    Recorded("localization/simulated_measures_loop5_delay0.5", "loop", "20413", 0.5, MARCH),
)
STARTS = ("consensus/line_6", "consensus/loop_6", "consensus/random_6")
SIZES = (50, 200, 500, 750, 1000)


def rows(data: Path, iterations: int, pings: int, seeds: int) -> Iterator[Row]:
    """The recordings of a folder; each value of the model is beside what was recorded, in ms."""
    for size in SIZES:
        recorded = statistics.fmean(float(line[0]) for line in _lines(data / f"latency/RTT{size}.csv"))
        model = statistics.fmean(round_trips(size, THESIS, pings, lock=LOCK))
        yield Row(f"round trip, {size} B, recorded", 1e3 * model, "ms", 1e3 * recorded, None)
    for run in RUNS:
        sleeps = 2.0 * run.delay
        recorded = pace(_iterations(data / run.folder)) - sleeps
        model = statistics.fmean(_iteration(run, iterations, seed) for seed in range(seeds)) - sleeps
        name = run.folder.rpartition("/")[2].removeprefix("simulated_measures_")
        yield Row(f"rest of an iteration, {name}, recorded", 1e3 * model, "ms", 1e3 * recorded, None)
    for run in RUNS:
        if run.folder in STARTS:
            begun, ready = _starts(data / run.folder)
            model = statistics.median(_start(run, begun, seed) for seed in range(5 * seeds))
            name = run.folder.rpartition("/")[2]
            yield Row(f"start after the last robot's, {name}, recorded", model, "s", ready, None)


def _lines(path: Path) -> list[list[str]]:
    with path.open(newline="") as file:
        return list(csv.reader(file))


def _robots(folder: Path) -> list[list[list[str]]]:
    return [_lines(path) for path in sorted(folder.glob("?.csv"))]


def _iterations(folder: Path) -> list[list[float]]:
    """When each robot had a new state. The programs of May also wrote when they sent (flag 1)."""
    flagged = folder.parent.name == "consensus" and not folder.name.startswith("old")
    return [[float(line[0]) for line in lines[1:] if not flagged or line[2] == "0"] for lines in _robots(folder)]


def _starts(folder: Path) -> tuple[list[float], float]:
    """When each robot began, s after the first one, and how long after the last one all had sent."""
    robots = _robots(folder)
    begun = [float(lines[0][0]) for lines in robots]
    sent = max(float(lines[1][0]) for lines in robots)
    return [each - min(begun) for each in begun], sent - max(begun)


def _iteration(run: Recorded, iterations: int, seed: int) -> float:
    poll, lock = run.program
    return Original(run.links(), THESIS, seed, poll=poll, lock=lock, delay=run.delay).paced(iterations)


def _start(run: Recorded, begun: Sequence[float], seed: int) -> float:
    """s from the last robot's start until all have sent."""
    time = EventQueue()
    radio = SlotRadio(time, sorted(run.order), THESIS, Random(f"{seed} slots"))
    calls = Calls(time, radio)
    links = run.links()
    up: set[tuple[str, str]] = set()

    def call(link: tuple[str, str]) -> None:
        calls.call(*link, 99.0, partial(done, link))

    def done(link: tuple[str, str], made: RadioLink | None, reason: str) -> None:
        if made is None:
            time.at(time.now + AGAIN * (0.5 + radio.random.random()), call, link)
        else:
            up.add(link)
            if len(up) == len(links):
                time.stop()

    for name, at in zip(sorted(run.order), begun, strict=True):
        time.at(at, calls.reachable.add, name)
        for link in links:
            if link[0] == name:
                time.at(at, call, link)
    time.run(120.0)
    return time.now - max(begun) + radio.random.uniform(*SLEEPS)


def missing(data: Path) -> Sequence[str]:
    """Which of the recordings are missing, by name."""
    wanted = [*(f"latency/RTT{size}.csv" for size in SIZES), *(run.folder for run in RUNS)]
    return [name for name in wanted if not (data / name).exists()]
