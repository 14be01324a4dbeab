"""Lockstep over links that are cut for 1 s every 20 s: nothing lost, nothing doubled, and what it costs in time.

Each trajectory is compared with the undisturbed one, of virtual time. Robots as in `bench.lockstep.lockstep`: bus,
mesh and app; with all processes of six robots one graph is told beside them.
"""

import math
import random
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.lockstep import model as lockstep_model
from bench.lockstep.lockstep import JITTER_GOAL, JITTER_S, LATENCY_S, NAMES, TOPOLOGIES
from bench.lockstep.model import Outage
from bench.rigs import talking_sim
from bench.rigs.simulation import SWARM_SIM, Simulation
from bench.rows import Row
from services.mesh.links.radio_model import AirModel
from sim.virtual.run import run_virtually
from swarm.core.graph import Graph
from swarm.core.lockstep.links import SILENT_AFTER, SILENT_AFTER_RTTS
from swarm.core.lockstep.questions import WANT_AFTER
from swarm.recording.trajectory import WARM_UP, Trajectory

APP = Path(__file__).parents[1] / "rigs/lattice.py"
CUT_S = 1.0
PERIOD_S = 21.0
"""In each one a link is cut once, at random: 4.8 % of the time."""

SEED = 4
"""One whose cuts cost the model what they cost it on average."""

MODELS = (
    ("waits until they end", None, None),
    ("goes around them", WANT_AFTER + max(SILENT_AFTER_RTTS * 2 * LATENCY_S, SILENT_AFTER), JITTER_GOAL),
)
"""What the model does, after how many s it goes around a cut, and the goal."""

TAGGED_AND_RESUME_S = {"line": 0.0507, "loop": 0.0522, "thesis-d": 0.0669, "full": 0.0928}
"""Mean iteration of a discrete-event simulation of tagged messages with resume after a cut, made when this protocol was
designed: latency 30 +- 10 ms, 1.4 ms for a step, exponentially distributed cuts, 4.8 % of the time. One draw of cuts
each: with ours the same model gives 48.9, 52.9, 65.1 and 89.9 ms, the mean of 24 seeds (standard deviation 1.1, 1.2,
1.6 and 3 ms)."""


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    topologies: tuple[str, ...] = TOPOLOGIES
    iterations: int = 1200
    runs: int = 3
    """The median of so many runs counts. Where the host stands still for a second, all links are cut."""

    whole: str = "loop"
    """The graph whose limit asks for most is run once with all processes, too."""


FULL = Sizes()
SMOKE = Sizes(("line",), 40, 1, "line")


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    for topology in sizes.topologies:
        graph = Graph.of_shape(topology, NAMES)
        undisturbed = run_virtually(*_swarm(topology, sizes.iterations), rows=True)[1].trajectories
        cuts = outages(graph, sizes.iterations)
        runs = [_run(topology, sizes.iterations, talking_sim.PROGRAM, _options(cuts)) for _ in range(sizes.runs)]
        # A value that stands twice with different bits is an error of `read` already.
        differ = sum(differing(undisturbed, paths, sizes.iterations) for paths in runs)
        yield Row(f"values that differ, {topology} 6", differ, "", 1.0, 0.0)
        mean, stated = statistics.median(map(_mean, runs)), TAGGED_AND_RESUME_S[topology]
        yield Row(f"mean iteration, {topology} 6, 1 s cuts", mean, "s", stated, 1.0)
        for what, around_after, goal in MODELS:
            air = AirModel(LATENCY_S, JITTER_S, seed=SEED)
            model = lockstep_model.run(graph, air, sizes.iterations, cuts, around_after=around_after)
            limit = lockstep_model.mean_iteration(model, first=WARM_UP)
            yield Row(f"the same beside a model with the same cuts that {what}", mean, "s", limit, goal)
        if topology == sizes.whole:
            paths = _run(topology, sizes.iterations, SWARM_SIM, _options(cuts))
            differ = differing(undisturbed, paths, sizes.iterations)
            yield Row(f"values that differ, {topology} 6, all processes", differ, "", 1.0, 0.0)
            yield Row(f"mean iteration, {topology} 6, 1 s cuts, all processes", _mean(paths), "s", stated, None)


def outages(graph: Graph, iterations: int) -> list[Outage]:
    """The cuts of all links, for longer than the run lasts."""
    draw = random.Random(SEED)
    periods = math.ceil(iterations * 0.15 / PERIOD_S)
    return [
        Outage(link, PERIOD_S * period + draw.uniform(0.0, PERIOD_S - CUT_S), CUT_S)
        for link in graph.edges
        for period in range(periods)
    ]


def differing(expected: Mapping[str, Trajectory], found: Mapping[str, Trajectory], iterations: int) -> float:
    """How many values of all robots and iterations are not equal to the bit; nan for a run that stopped short."""
    if any(sorted(path.rows) != list(range(iterations + 1)) for path in (*expected.values(), *found.values())):
        return math.nan
    return float(sum(path.rows[k] != found[name].rows[k] for name, path in expected.items() for k in path.rows))


def _options(cuts: Sequence[Outage]) -> list[str]:
    options = ["--latency", f"{LATENCY_S}s", "--jitter", f"{JITTER_S}s"]
    for cut in cuts:
        options += ["--cut", f"{'-'.join(cut.link)}@{cut.at:.3f}s,{cut.seconds:g}s"]
    return options


def _swarm(topology: str, iterations: int) -> list[str]:
    """The arguments that every run has."""
    swarm = ("--robots", "6", "--topology", topology, "--iterations", str(iterations), "--seed", str(SEED))
    return [str(APP), *swarm]


def _run(topology: str, iterations: int, program: Sequence[str], options: Sequence[str]) -> dict[str, Trajectory]:
    with Simulation(*_swarm(topology, iterations), *options, program=program) as simulation:
        simulation.finish(600.0)
        return {name: simulation.trajectory(name, APP.stem) for name in NAMES}


def _mean(paths: Mapping[str, Trajectory]) -> float:
    return lockstep_model.mean_iteration({name: path.times for name, path in paths.items()}, first=WARM_UP)
