"""The slot radio: its fit to the thesis' recordings, and lockstep over it by our own cores.

First the model beside recorded runs (`bench.radio_fit`; SWARM_THESIS_DATA names their folder, and what is missing there
is named). Then consensus of `swarm sim --virtual --radio slots`: mesh and apps with their real cores, which are held
against the best that one link for each edge gave in a model of our messages. Beside it the original's pattern without
its sleeps on the same radio, and the least that one piconet allows: no loss, no time in hosts, polls without a pause.
`links = auto` is a hub that calls all others.
How long a bridge stays is not known, so that is swept: graphs of several piconets depend on it, one piconet does not.
"""

import statistics
from collections.abc import Iterator
from dataclasses import dataclass

from bench import radio_fit
from bench.apps import RECORDINGS
from bench.radio_patterns import Bundled, Original
from bench.rows import Row, number
from sim.slots.parameters import THESIS, Parameters
from sim.virtual.run import simulate
from swarm.core.graph import Graph

GRAPHS = {"line 3": 0.017, "line 6": 0.094, "loop 6": 0.113, "thesis-d 6": 0.232, "full 6": 0.887}
"""s an iteration with the best roles, of a model of our messages."""
GOAL = 1.15

HUB = {"line 3": 0.025, "line 6": 0.05, "loop 6": 0.05, "thesis-d 6": 0.06, "full 6": 0.075}
"""s an iteration at most where links are what suits the radio."""

START = 4.0
"""s at most until six robots iterate where links are what suits the radio."""

STAYS = (0.05, 0.2, 0.3)
"""s, besides that of the fit."""

LEAST = Parameters(poll_busy=2, loss=0.0, host=0.0, uart=1e12, scan=1e6)
COMPUTE = 0.002
"""s of a step in an app's process, on average: virtual time has none."""


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    graphs: tuple[str, ...] = tuple(GRAPHS)
    iterations: int = 200
    rivals: int = 60
    """Iterations of the other patterns."""
    seeds: int = 3
    stays: tuple[float, ...] = STAYS
    pings: int = 100


FULL = Sizes()
SMOKE = Sizes(("line 3", "loop 6"), 20, 10, 1, (0.2,), 5)


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    if missing := radio_fit.missing(RECORDINGS):
        yield Row(f"no recordings: {missing[0]}", float(len(missing)), "", 1.0, None)
    else:
        yield from radio_fit.rows(RECORDINGS, sizes.rivals, sizes.pings, sizes.seeds)
    for name in sizes.graphs:
        shape, robots = name.split()
        ours = [_consensus(shape, robots, sizes.iterations, seed, "slots") for seed in range(sizes.seeds)]
        yield Row(f"iteration, {name}", 1e3 * _mean(ours, "seconds"), "ms", 1e3 * GRAPHS[name], GOAL)
        hub = [_consensus(shape, robots, sizes.iterations, seed, "slots", links="auto") for seed in range(sizes.seeds)]
        yield Row(f"iteration, links = auto, {name}", 1e3 * _mean(hub, "seconds"), "ms", 1e3 * HUB[name], 1.0)
        start = statistics.median(number(run, "started_s") for run in hub)
        yield Row(f"start, links = auto, {name}", start, "s", START, 1.0)
        yield Row(f"messages an iteration, {name}", _mean(ours, "messages"), "", 2.0 * len(_edges(name)), None)
        yield Row(f"start, {name}", statistics.median(number(run, "started_s") for run in ours), "s", 1.0, None)
        for stay in sizes.stays:
            runs = [
                _consensus(shape, robots, sizes.iterations, seed, f"slots:stay={stay}") for seed in range(sizes.seeds)
            ]
            yield Row(
                f"iteration, {name}, stays of {stay:g} s", 1e3 * _mean(runs, "seconds"), "ms", 1e3 * GRAPHS[name], None
            )
        original = statistics.fmean(_original(name, sizes.rivals, seed) for seed in range(sizes.seeds))
        yield Row(f"the original's pattern, {name}", 1e3 * original, "ms", 1e3 * GRAPHS[name], None)
        for text, parameters, compute in (("one piconet, bundled", Parameters(), COMPUTE), ("least", LEAST, 0.0)):
            least = _bundled(name, sizes.rivals, parameters, compute)
            yield Row(f"{text}, {name}", 1e3 * least, "ms", 1e3 * GRAPHS[name], None)


def _consensus(
    shape: str, robots: str, iterations: int, seed: int, radio: str, *, links: str = "graph"
) -> dict[str, object]:
    report, _ = simulate(
        "consensus", "--robots", robots, "--topology", shape, "--iterations", str(iterations), "--seed", str(seed),
        "--radio", radio, "--links", links,
    )  # fmt: skip
    return report


def _mean(runs: list[dict[str, object]], what: str) -> float:
    """Of a figure of each run, an iteration."""
    return statistics.fmean(number(run, what) / max(1.0, number(run, "iterations")) for run in runs)


def _edges(name: str) -> list[tuple[str, str]]:
    """Of a graph; the robot with the lower name calls."""
    shape, robots = name.split()
    return sorted(Graph.of_shape(shape, [f"r{number}" for number in range(int(robots))]).edges)


def _original(name: str, iterations: int, seed: int) -> float:
    poll, lock = radio_fit.MARCH
    run = Original(_edges(name), THESIS, seed, poll=poll, lock=lock)
    while min(map(len, run.times.values())) < iterations:
        run.time.run(run.time.now + 10.0)
    return run.iteration()


def _bundled(name: str, iterations: int, parameters: Parameters, compute: float) -> float:
    run = Bundled(_edges(name), parameters, 1, compute=compute)
    while min(map(len, run.times.values())) < iterations:
        run.time.run(run.time.now + 1.0)
    return run.iteration()
