"""Lockstep over links that are cut for 1 s every 20 s: nothing lost, nothing doubled, and what it costs in time."""

import math
import random
from collections.abc import Iterator, Mapping
from pathlib import Path

from bench import lockstep_model
from bench.lockstep import JITTER_GOAL, JITTER_S, LATENCY_S, NAMES, TOPOLOGIES
from bench.lockstep_model import Outage
from bench.rows import Row
from bench.simulation import Simulation
from services.mesh.core.delay import AirModel
from swarm.core.graph import Graph
from swarm.recording.trajectory import WARM_UP, Trajectory

APP = Path(__file__).with_name("lattice.py")
CUT_S = 1.0
PERIOD_S = 21.0
"""In each one a link is cut once, at random: 4.8 % of the time."""

SEED = 4
"""One whose cuts cost the model what they cost it on average."""

ITERATIONS = 1200

TAGGED_AND_RESUME_S = {"line": 0.0507, "loop": 0.0522, "thesis-d": 0.0669, "full": 0.0928}
"""Mean iteration of a discrete-event simulation of tagged messages with resume after a cut, made when this protocol was
designed: latency 30 +- 10 ms, 1.4 ms for a step, exponentially distributed cuts, 4.8 % of the time. One draw of cuts
each: with ours the same model gives 48.9, 52.9, 65.1 and 89.9 ms, the mean of 24 seeds (standard deviation 1.1, 1.2,
1.6 and 3 ms)."""


def rows() -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    for topology in TOPOLOGIES:
        graph = Graph.of_shape(topology, NAMES)
        arguments = (
            str(APP),
            "--robots",
            "6",
            "--topology",
            topology,
            "--iterations",
            str(ITERATIONS),
            "--seed",
            str(SEED),
        )
        undisturbed = _run(*arguments, "--latency", "0ms")
        cuts = outages(graph)
        options = [
            option for cut in cuts for option in ("--cut", f"{'-'.join(cut.link)}@{cut.at:.3f}s,{cut.seconds:g}s")
        ]
        paths = _run(*arguments, "--latency", f"{LATENCY_S}s", "--jitter", f"{JITTER_S}s", *options)
        # A value that stands twice with different bits is an error of `read` already.
        yield Row(f"values that differ, {topology} 6", differing(undisturbed, paths), "", 1.0, 0.0)
        mean = lockstep_model.mean_iteration({name: path.times for name, path in paths.items()}, first=WARM_UP)
        yield Row(f"mean iteration, {topology} 6, 1 s cuts", mean, "s", TAGGED_AND_RESUME_S[topology], 1.0)
        model = lockstep_model.run(graph, AirModel(LATENCY_S, JITTER_S, seed=SEED), ITERATIONS, cuts)
        limit = lockstep_model.mean_iteration(model, first=WARM_UP)
        yield Row("the same beside a model with the same cuts", mean, "s", limit, JITTER_GOAL)


def outages(graph: Graph) -> list[Outage]:
    """The cuts of all links, for longer than the run lasts."""
    draw = random.Random(SEED)
    periods = math.ceil(ITERATIONS * 0.15 / PERIOD_S)
    return [
        Outage(link, PERIOD_S * period + draw.uniform(0.0, PERIOD_S - CUT_S), CUT_S)
        for link in graph.edges
        for period in range(periods)
    ]


def differing(expected: Mapping[str, Trajectory], found: Mapping[str, Trajectory]) -> float:
    """How many values of all robots and iterations are not equal to the bit; nan for a run that stopped short."""
    if any(sorted(path.rows) != list(range(ITERATIONS + 1)) for path in (*expected.values(), *found.values())):
        return math.nan
    return float(sum(path.rows[k] != found[name].rows[k] for name, path in expected.items() for k in path.rows))


def _run(*arguments: str) -> dict[str, Trajectory]:
    with Simulation(*arguments) as simulation:
        simulation.finish(600.0)
        return {name: simulation.trajectory(name, APP.stem) for name in NAMES}
