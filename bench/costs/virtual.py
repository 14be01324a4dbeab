"""Virtual time: how long swarms of all sizes take to compute. In CPU time of one core, which is what a run can use.

Each run has a process of its own, as for a user, so that none finds the memory of another. What a robot's iteration
takes in a swarm of 1000 beside one of 100 is measured in turns: ten runs of 100 robots, then one of 1000, which are as
many iterations and starts of robots, of graphs with as many links a robot. The median of the turns' ratios counts:
what else goes on in a shared machine changes both, and from minute to minute.
"""

import json
import linecache
import multiprocessing
import os
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bench.rows import Row
from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.virtual.run import PLACE, VirtualRun

SIX_S, THOUSAND_S, TEN_THOUSAND_S = 1.0, 8.0, 120.0
NOTEBOOK_S = 2.0
NOTEBOOK = Path(__file__).parents[2] / "examples" / "consensus.ipynb"
FLAT = 1.3


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    six: int = 1000
    """Iterations of six robots."""

    few: int = 100
    """Robots of a turn's small swarm; `many` and `most` are those of larger ones."""

    many: int = 1000
    most: int = 10_000
    iterations: int = 100
    turns: int = 3


FULL = Sizes()
SMOKE = Sizes(20, 10, 20, 40, 5, 1)


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    yield Row(f"6 robots, {sizes.six} iterations, whole mesh", _alone(6, "loop", sizes.six), "s", SIX_S, 1.0)
    yield Row("the same by swarm.simulate, with all states", _library(6, "loop", sizes.six), "s", SIX_S, 1.0)
    yield Row("the notebook's consensus, from import to plot", _notebook(), "s", NOTEBOOK_S, 1.0)
    iterations = sizes.iterations
    settled = "random:1", iterations, "--mesh", "settled"
    # As many iterations and starts of robots on both sides of a turn.
    times = sizes.many // sizes.few
    turns = [
        (sum(_alone(sizes.few, *settled) for _ in range(times)) / times, _alone(sizes.many, *settled))
        for _ in range(sizes.turns)
    ]
    few, many = (statistics.median(each) for each in zip(*turns, strict=True))
    yield Row(f"{sizes.few} robots, {iterations} iterations, settled mesh", few, "s", few, None)
    yield Row(f"{sizes.many} robots, {iterations} iterations, settled mesh", many, "s", THOUSAND_S, None)
    library = _library(sizes.many, "random:1", iterations)
    yield Row(f"{sizes.many} robots, {iterations} iterations, by swarm.simulate", library, "s", THOUSAND_S, 1.0)
    ratio = statistics.median(large / small / times for small, large in turns)
    yield Row(f"a robot's iteration, {sizes.many} beside {sizes.few}", ratio, "", 1.0, FLAT)
    yield Row("the same, least of the turns", min(large / small / times for small, large in turns), "", 1.0, None)
    yield Row("the same, most of the turns", max(large / small / times for small, large in turns), "", 1.0, None)
    most = _alone(sizes.most, "random:1", iterations, "--mesh", "delay")
    yield Row(f"{sizes.most} robots, {iterations} iterations, delays", most, "s", TEN_THOUSAND_S, 1.0)


def _library(*run: object) -> float:
    """CPU time of `swarm.simulate` and of the states as an array, s, in a process of its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        seconds: float = pool.apply(_library_seconds, run)
    return seconds


def _library_seconds(robots: int, topology: str, iterations: int) -> float:
    from swarm import simulate  # so that its import does not count

    began = time.process_time()
    states = simulate("consensus", robots=robots, topology=topology, iterations=iterations)["value"]
    assert states.shape == (iterations + 1, robots)
    return time.process_time() - began


def _notebook() -> float:
    """CPU time of the first code cell of `NOTEBOOK`, its imports among it, s, in a process of its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        seconds: float = pool.apply(_notebook_seconds)
    return seconds


def _notebook_seconds() -> float:
    os.environ["MPLBACKEND"] = "agg"
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    text = "".join(next(cell["source"] for cell in cells if cell["cell_type"] == "code"))
    began = time.process_time()
    names: dict[str, object] = {"__name__": "__main__"}
    linecache.cache["cell"] = len(text), None, text.splitlines(keepends=True), "cell"
    exec(compile(text, "cell", "exec"), names)  # noqa: S102 - as a kernel does
    return time.process_time() - began


def _alone(*run: object) -> float:
    """`_seconds` in a process of its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        seconds: float = pool.apply(_seconds, run)
    return seconds


def _seconds(robots: int, topology: str, iterations: int, *more: str) -> float:
    options = parse(
        [*f"consensus --virtual --robots {robots} --topology {topology} --iterations {iterations}".split(), *more]
    )
    run = VirtualRun(options, build(options, PLACE))
    began = time.process_time()
    run.go()
    return time.process_time() - began
