"""The slot radio: its fit to the thesis' recordings, and lockstep over it by our own cores.

First the model beside recorded runs (`bench.radio.fit`; SWARM_THESIS_DATA names their folder, and what is missing there
is named). Then consensus of `swarm sim --virtual --radio slots`: mesh and apps with their real cores, which are held
against the best that one link for each edge gave in a model of our messages. Beside it the original's pattern without
its sleeps on the same radio, and the least that one piconet allows: no loss, no time in hosts, polls without a pause.
`links = auto` is a hub that calls all others.
Where the hub has a weak link, stands in a poor place or does not hear a robot, `links = auto` measures and chooses
another hub; `links = star` keeps the first robot.
How long a bridge stays is not known, so that is swept: graphs of several piconets depend on it, one piconet does not.
"""

import math
import statistics
from collections.abc import Iterator
from dataclasses import dataclass

from bench.apps.apps import RECORDINGS
from bench.radio import fit as radio_fit
from bench.radio.patterns import Bundled, Original
from bench.radio.swarm import SIZE, Trouble, fail_over, long_pace, pace, start, transfer, troubled
from bench.rows import Row
from sim.slots.parameters import THESIS, SlotParameters
from swarm.core.graph import Graph

GRAPHS = {"line 3": 0.017, "line 6": 0.094, "loop 6": 0.113, "thesis-d 6": 0.232, "full 6": 0.887}
"""s an iteration with the best roles, of a model of our messages."""
GOAL = 1.15

HUB = {"line 3": 0.025, "line 6": 0.05, "loop 6": 0.05, "thesis-d 6": 0.06, "full 6": 0.075}
"""s an iteration at most where links are what suits the radio."""

START = 4.0
"""s at most until six robots iterate where links are what suits the radio."""

START_GRAPH = 14.0
"""The same on the full graph with a link for each edge."""

TROUBLED = 220.0
"""s of a run whose hub is in trouble."""

EIGHT = 0.11
"""s an iteration at most of eight robots on the full graph."""

FAIL_OVER, ABSENT, BESIDE = 12.0, 1.05, 2.0
"""s without an iteration at most when the hub is lost; the ratios of an iteration with an absent robot, and beside a
large message."""

TROUBLES = {
    "weak link r0-r3": Trouble({frozenset(("r0", "r3")): 0.6}),
    "r0 in a poor place": Trouble({frozenset(("r0", f"r{place}")): 0.5 for place in range(1, 6)}),
    "r0 does not hear r5": Trouble({}, [("r0", "r5")]),
    "r3 in a poor place": Trouble({frozenset(("r3", f"r{place}")): 0.6 for place in (0, 1, 2, 4, 5)}),
}
"""What is wrong around a hub. A poor place of another robot no hub can mend."""

RATE = 176_000.0 / 2
"""bytes/s of a saturated link, shared by the two hops of one piconet."""

STAYS = (0.05, 0.2, 0.3)
"""s, besides that of the fit."""

LEAST = SlotParameters(poll_busy=2, loss=0.0, host=0.0, uart=1e12, scan=1e6)
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
    starts: int = 200
    losses: int = 20
    seconds: float = 200.0
    """Of runs beside an absent robot, which is called each 100 to 150 s."""
    size: int = SIZE
    """Bytes of the large message."""
    trouble: tuple[str, ...] = ("line 6", "thesis-d 6", "full 6")
    """Graphs on which the hub is in trouble."""


FULL = Sizes()
SMOKE = Sizes(("line 3", "loop 6"), 20, 10, 1, (0.2,), 5, 2, 1, 20.0, 20_000, ())


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    if missing := radio_fit.missing(RECORDINGS):
        yield Row(f"no recordings: {missing[0]}", float(len(missing)), "", 1.0, None)
    else:
        yield from radio_fit.rows(RECORDINGS, sizes.rivals, sizes.pings, sizes.seeds)
    for name in sizes.graphs:
        yield from _iterations(name, sizes)
    eight = [pace("full 8", sizes.iterations, seed, links="auto") for seed in range(sizes.seeds)]
    yield Row("iteration, links = auto, full 8", 1e3 * statistics.fmean(eight), "ms", 1e3 * EIGHT, 1.0)
    for links, limit in (("auto", START), ("graph", START_GRAPH)):
        starts = [start("full 6", seed, links=links) for seed in range(sizes.starts)]
        yield Row(f"start, links = {links}, full 6, median", statistics.median(starts), "s", limit, 1.0)
        failed = sum(math.isinf(each) for each in starts)
        # A limit of a half start and a goal of 1: none may fail.
        yield Row(f"starts that failed, links = {links}, full 6, of {sizes.starts}", failed, "", 0.5, 1.0)
    lost = max(fail_over("thesis-d 6", seed) for seed in range(sizes.losses))
    yield Row(f"hub lost, until the others iterate, longest of {sizes.losses}", lost, "s", FAIL_OVER, 1.0)
    away, without = long_pace("full 6", sizes.seconds, 0, absent="r5"), long_pace("full 5", sizes.seconds, 0)
    yield Row("iteration with one of six absent, beside five", 1e3 * away, "ms", 1e3 * without, ABSENT)
    for name in sizes.trouble:
        yield from _troubles(name)
    for name in sizes.graphs[-2:]:
        quiet, busy, took = transfer(name, 90.0, 0, sizes.size)
        yield Row(f"iteration beside a large message, {name}, beside quiet", 1e3 * busy, "ms", 1e3 * quiet, BESIDE)
        yield Row(f"large message over two hops, {name}", took, "s", sizes.size / RATE, None)


def _troubles(name: str) -> Iterator[Row]:
    """Rows of one graph with a hub in trouble: links of the graph, the first hub, and the one that was measured."""
    for text, trouble in TROUBLES.items():
        graph, star, auto = (troubled(name, TROUBLED, 0, trouble, links=links) for links in ("graph", "star", "auto"))
        yield Row(f"{text}, links = graph, {name}, beside star", 1e3 * graph[0], "ms", 1e3 * star[0], None)
        yield Row(f"{text}, links = auto ({auto[1]}), {name}, beside star", 1e3 * auto[0], "ms", 1e3 * star[0], 1.2)


def _iterations(name: str, sizes: Sizes) -> Iterator[Row]:
    """Rows of one graph: our cores with links of the graph and of a hub, swept stays, rivals, bounds."""
    limit = 1e3 * GRAPHS[name]

    def mean(links: str, radio: str = "slots") -> float:
        return 1e3 * statistics.fmean(
            pace(name, sizes.iterations, seed, links=links, radio=radio) for seed in range(sizes.seeds)
        )

    yield Row(f"iteration, links = graph, {name}", mean("graph"), "ms", limit, GOAL)
    yield Row(f"iteration, links = auto, {name}", mean("auto"), "ms", 1e3 * HUB[name], 1.0)
    for stay in sizes.stays:
        yield Row(
            f"depends on stays: {stay:g} s, graph, {name}", mean("graph", f"slots:stay={stay}"), "ms", limit, None
        )
    original = statistics.fmean(_original(name, sizes.rivals, seed) for seed in range(sizes.seeds))
    yield Row(f"the original's pattern, {name}", 1e3 * original, "ms", limit, None)
    for text, parameters, compute in (("one piconet, bundled", SlotParameters(), COMPUTE), ("least", LEAST, 0.0)):
        yield Row(f"{text}, {name}", 1e3 * _bundled(name, sizes.rivals, parameters, compute), "ms", limit, None)


def _edges(name: str) -> list[tuple[str, str]]:
    """Of a graph; the robot with the lower name calls."""
    shape, robots = name.split()
    return sorted(Graph.of_shape(shape, [f"r{number}" for number in range(int(robots))]).edges)


def _original(name: str, iterations: int, seed: int) -> float:
    poll, lock = radio_fit.MARCH
    return Original(_edges(name), THESIS, seed, poll=poll, lock=lock).paced(iterations)


def _bundled(name: str, iterations: int, parameters: SlotParameters, compute: float) -> float:
    return Bundled(_edges(name), parameters, 1, compute=compute).paced(iterations, turn=1.0)
