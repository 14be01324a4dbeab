"""Virtual time: how long swarms of all sizes take to compute. In CPU time of one core, which is what a run can use.

Each run has a process of its own, as for a user, so that none finds the memory of another. What a robot's iteration
takes in a swarm of 1000 beside one of 100 is measured in turns: ten runs of 100 robots, then one of 1000, which are as
many iterations and starts of robots, of graphs with as many links a robot. The median of the turns' ratios counts:
what else goes on in a shared machine changes both, and from minute to minute.
"""

import multiprocessing
import statistics
import time
from collections.abc import Iterator

from bench.rows import Row
from services.sim.options import parse
from services.sim.scenario import build
from services.sim.virtual.run import PLACE, Run

SIX_S, THOUSAND_S, TEN_THOUSAND_S = 1.0, 60.0, 120.0
FLAT = 1.3
TURNS = 3
ITERATIONS = 100


def rows() -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    yield Row("6 robots, 1000 iterations, whole mesh", _alone(6, "loop", 1000), "s", SIX_S, 1.0)
    settled = "random:1", ITERATIONS, "--mesh", "settled"
    turns = [(sum(_alone(100, *settled) for _ in range(10)) / 10, _alone(1000, *settled)) for _ in range(TURNS)]
    hundred, thousand = (statistics.median(each) for each in zip(*turns, strict=True))
    yield Row("100 robots, 100 iterations, settled mesh", hundred, "s", hundred, None)
    yield Row("1000 robots, 100 iterations, settled mesh", thousand, "s", THOUSAND_S, 1.0)
    ratio = statistics.median(large / small / 10 for small, large in turns)
    yield Row("a robot's iteration, 1000 beside 100", ratio, "", 1.0, FLAT)
    yield Row("the same, least of the turns", min(large / small / 10 for small, large in turns), "", 1.0, None)
    yield Row("the same, most of the turns", max(large / small / 10 for small, large in turns), "", 1.0, None)
    ten_thousand = _alone(10_000, "random:1", ITERATIONS, "--mesh", "delay")
    yield Row("10 000 robots, 100 iterations, delays", ten_thousand, "s", TEN_THOUSAND_S, 1.0)


def _alone(*run: object) -> float:
    """`_seconds` in a process of its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        seconds: float = pool.apply(_seconds, run)
    return seconds


def _seconds(robots: int, topology: str, iterations: int, *more: str) -> float:
    options = parse(
        ["consensus", "--virtual", "--robots", str(robots), "--topology", topology, "--iterations", str(iterations),
         *more]
    )  # fmt: skip
    run = Run(options, build(options, PLACE))
    began = time.process_time()
    run.go()
    return time.process_time() - began
