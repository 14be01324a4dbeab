"""Virtual time: how long swarms of all sizes take to compute. In CPU time of one core, which is what a run can use."""

import time
from collections.abc import Iterator

from bench.rows import Row
from services.sim.options import parse
from services.sim.scenario import build
from services.sim.virtual.run import PLACE, Run

SIX_S, THOUSAND_S, TEN_THOUSAND_S = 1.0, 60.0, 120.0


def rows() -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    yield Row("6 robots, 1000 iterations, whole mesh", _seconds(6, "loop", 1000), "s", SIX_S, 1.0)
    # The least of some runs: neighbours on a shared machine take up to half of the time of a short one.
    hundred = min(_seconds(100, "random:1", 100, "--mesh", "settled") for _ in range(6))
    yield Row("100 robots, 100 iterations, settled mesh", hundred, "s", hundred, None)
    thousand = min(_seconds(1000, "random:1", 100, "--mesh", "settled") for _ in range(2))
    yield Row("1000 robots, 100 iterations, settled mesh", thousand, "s", THOUSAND_S, 1.0)
    yield Row("a robot's iteration, 1000 beside 100", thousand / 1e5 * 1e6, "us", hundred / 1e4 * 1e6, 1.3)
    ten_thousand = _seconds(10_000, "random:1", 100, "--mesh", "delay")
    yield Row("10 000 robots, 100 iterations, delays", ten_thousand, "s", TEN_THOUSAND_S, 1.0)


def _seconds(robots: int, topology: str, iterations: int, *more: str) -> float:
    options = parse(
        ["consensus", "--virtual", "--robots", str(robots), "--topology", topology, "--iterations", str(iterations),
         *more]
    )  # fmt: skip
    run = Run(options, build(options, PLACE))
    began = time.process_time()
    run.go()
    return time.process_time() - began
