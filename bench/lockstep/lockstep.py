"""Time of a lockstep iteration, app to app through bus and mesh, beside what the links' latency and jitter allow.

The robots that are judged have the processes that take part in it: bus, mesh and app, 18 of six robots
(`bench.rigs.talking_sim`). On a robot the balancer has one of four cores to itself; the thesis' figure on emulated
links is of its one process a robot, without balancer, too. All processes of six robots, 36 on this computer's cores,
are told beside them.

The thesis' pattern of messages runs over the same emulated links, in virtual time: its code has no licence, so the
pattern is written anew (`bench.radio.patterns`). The unmodified code took 0.201 s (line 3, loop 6) and 0.301 s (line 6,
full 6) on links of 30 ms, and 0.201 s on links of 0 ms.
"""

import contextlib
import functools
import itertools
import statistics
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from bench.lockstep import model as lockstep_model
from bench.radio.patterns import Original
from bench.rigs import talking_sim
from bench.rigs.simulation import SWARM_SIM, Simulation, simulate
from bench.rows import Row, measured, number, possible
from services.mesh.links.radio_model import AirModel
from sim.virtual.run import run_virtually
from swarm.bus.zenoh_bus import Bus
from swarm.core.graph import Graph
from swarm.recording import trajectory
from swarm.recording.trajectory import Trajectory

LATENCY_S = 0.03
"""One way, as the thesis' radio at small payloads (round trip 59 ms for 50 bytes, figure 3.19)."""

JITTER_S = 0.01
"""Standard deviation of the latency, as measured on the same radio."""

NAMES = tuple(f"r{index}" for index in range(6))
TOPOLOGIES = ("line", "loop", "thesis-d", "full")
GOAL = 1.15
JITTER_GOAL = 1.1
STARTING = 3
"""Messages for each link and direction that a start may take: x(0) again, as the first went nowhere before the link was
up, with the question for the other's x(0), and the answer to the other's question."""

_HEAD = struct.Struct("<BI")  # of a frame: kind, iteration (docs/reference/network/lockstep.md)

ZERO_GOAL_S = 2.5e-3
"""Budget of an iteration where the links take no time: what bus, mesh and app cost themselves."""

SLOTS_GOAL = 1.3
"""Of an iteration over the slot radio beside the same run in virtual time, where only the radio takes time."""

START_LIMIT_S = 6.0

THESIS_POLL_S, THESIS_DELAY_S = 0.1, 0.05
"""What the thesis' programs sleep while something lacks, and twice an iteration: the least that they ran with here."""


@dataclass(frozen=True)
class Sizes:
    """How much the area measures."""

    topologies: tuple[str, ...] = TOPOLOGIES
    iterations: int = 300
    counted: tuple[int, int] = (50, 250)
    """The messages of these iterations are counted."""

    jitter_runs: int = 3
    """The median of so many runs counts: what a host in a bad half minute adds is more than this goal leaves."""

    model_iterations: int = 3000
    """Enough for the model's median to settle within 0.2 %."""

    zero_iterations: int = 2000
    slot_topologies: tuple[str, ...] = ("thesis-d",)
    thesis_runs: int = 10
    thesis_iterations: int = 100


FULL = Sizes()
SMOKE = Sizes(("line",), 40, (5, 15), 1, 100, 60, ("line",), 1, 10)


def rows(sizes: Sizes = FULL) -> Iterator[Row]:
    """Measure; yields rows as they are there."""
    for topology in sizes.topologies:
        run = _consensus(topology, talking_sim.PROGRAM, sizes.iterations)
        ours = number(run, "iteration_s_median")
        yield Row(f"lockstep {topology} 6, 30 ms links", ours, "s", LATENCY_S, GOAL)
        thesis = thesis_pattern(topology, NAMES, LATENCY_S, sizes)
        yield Row(f"the thesis' pattern, {topology} 6, 30 ms links, beside ours", thesis, "s", ours, None)
        yield from _messages(topology, sizes)
    for topology in sizes.topologies:
        # Twice as many iterations, for the median to settle.
        runs = [
            _consensus(topology, talking_sim.PROGRAM, 2 * sizes.iterations, jitter=True)
            for _ in range(sizes.jitter_runs)
        ]
        found = statistics.median(measured(number(run, "iteration_s_median") for run in runs))
        limit = jitter_limit(topology, sizes.model_iterations)
        yield Row(f"lockstep {topology} 6, 30 +- 10 ms links", found, "s", limit, JITTER_GOAL)
    yield from _slot_radio(sizes)
    options = ("--robots", "3", "--latency", "0ms", "--iterations", str(sizes.zero_iterations))
    run = simulate("consensus", *options, program=talking_sim.PROGRAM)
    ours = number(run, "iteration_s_median")
    yield Row("lockstep line 3, 0 ms links", ours, "s", ZERO_GOAL_S, 1.0)
    thesis = thesis_pattern("line", NAMES[:3], 0.0, sizes)
    yield Row("the thesis' pattern, line 3, 0 ms links, beside ours", thesis, "s", ours, None)
    starts = []
    for topology in sizes.topologies:
        run = _consensus(topology, SWARM_SIM, sizes.iterations)
        name = f"lockstep {topology} 6, 30 ms links, all processes"
        yield Row(name, number(run, "iteration_s_median"), "s", LATENCY_S, None)
        starts.append(number(run, "started_s"))
    yield Row("start of 6 robots, command to first iteration", max(measured(starts)), "s", START_LIMIT_S, 1.0)


def _consensus(topology: str, program: Sequence[str], iterations: int, *, jitter: bool = False) -> dict[str, object]:
    """Run six robots; return the simulation's report."""
    air = ("--latency", f"{LATENCY_S}s", *(("--jitter", f"{JITTER_S}s") if jitter else ()))
    options = ("--robots", "6", "--topology", topology, *air, "--iterations", str(iterations))
    return simulate("consensus", *options, program=program)


def _slot_radio(sizes: Sizes) -> Iterator[Row]:
    """Compare real processes over the slot radio with virtual time."""
    for topology, links in itertools.product(sizes.slot_topologies, ("auto", "graph")):
        swarm = ("--robots", "6", "--topology", topology, "--iterations", str(sizes.iterations))
        options = ("consensus", *swarm, "--radio", "slots", "--links", links)
        ours = number(simulate(*options, program=talking_sim.PROGRAM), "iteration_s_median")
        model = number(run_virtually(*options)[0], "iteration_s_median")
        yield Row(f"slot radio, links = {links}, {topology} 6, beside virtual time", ours, "s", model, SLOTS_GOAL)


def thesis_pattern(topology: str, names: Sequence[str], latency: float, sizes: Sizes = FULL) -> float:
    """s an iteration of the thesis' messages, polls and sleeps, in virtual time."""
    edges = sorted(Graph.of_shape(topology, names).edges)
    return statistics.fmean(
        Original(edges, latency, seed, poll=THESIS_POLL_S, delay=THESIS_DELAY_S, lock=0.0).paced(
            sizes.thesis_iterations
        )
        for seed in range(sizes.thesis_runs)
    )


def jitter_limit(topology: str, iterations: int = FULL.model_iterations) -> float:
    """s an iteration on links with jitter, by the discrete-event model, as a median over windows as in a real run."""
    graph = Graph.of_shape(topology, NAMES)
    times = lockstep_model.run(graph, AirModel(LATENCY_S, JITTER_S, seed=1), iterations)
    windows = trajectory.iteration_times({name: Trajectory((), path, {}) for name, path in times.items()})
    median = trajectory.median(windows)
    assert median is not None
    return median


def _messages(topology: str, sizes: Sizes) -> Iterator[Row]:
    """Frames that reach each robot's bus from its neighbours, counted in a run of its own: watching takes CPU time."""
    ways = 2 * len(Graph.of_shape(topology, NAMES).edges)
    counts: Counter[int] = Counter()

    def arrived(robot: str, key: str, payload: bytes) -> None:
        if key.split("/")[1] != robot:
            counts[_HEAD.unpack_from(payload)[1]] += 1

    options = ("--robots", "6", "--topology", topology, "--latency", "5ms", "--iterations", str(sizes.iterations))
    program = talking_sim.PROGRAM
    with Simulation("consensus", *options, program=program) as simulation, contextlib.ExitStack() as stack:
        for name in NAMES:
            bus = stack.enter_context(Bus.of(simulation.run_dir / name))
            bus.subscribe("swarm/*/app/consensus/sync/**", functools.partial(arrived, name))
        run = simulation.finish()
    first, last = sizes.counted
    counted = sum(counts[k] for k in range(first, last)) / (last - first)
    yield Row(f"messages an iteration, {topology} 6 (2E)", possible(counted, ways), "", ways, 1.0)
    beyond = number(run, "messages") - ways * (sizes.iterations + 1)
    yield Row(f"messages beyond 2E at the start, {topology} 6", possible(beyond, 0), "", STARTING * ways, 1.0)
