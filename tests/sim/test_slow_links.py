"""No constant of time breaks on a slow link: links form, lockstep goes on as fast as the links let it, and no link is
given up that carries. Over plain links of every kind, and over the slot radio."""

from statistics import fmean

import pytest
from slot_exchange import Exchange, frames_of, ways_of

from bench.radio.patterns import pace
from services.mesh.core.routing.physical_links import callers, physical
from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.slots.parameters import SlotParameters
from sim.virtual.run import PLACE, VirtualRun
from swarm.core.graph import Graph

GRAPHS = (("3", "line"), ("6", "line"), ("6", "loop"), ("6", "thesis-d"), ("4", "full"))


class Ran:
    """A run of consensus to its last iteration."""

    def __init__(self, graph, iterations, *more):
        robots, shape = graph
        options = parse(["consensus", "--virtual", "--robots", robots, "--topology", shape,
                         "--iterations", str(iterations), *more])  # fmt: skip
        run = VirtualRun(options, build(options, PLACE))
        advanced = run.advanced
        self.moments: dict[str, list[float]] = {}
        """The times of each robot's iterations."""

        def note(source, line):
            self.moments.setdefault(source.robot, []).append(run.world.time.now)
            advanced(source, line)

        run.advanced = note
        self.outcome = run.go()
        meshes = [robot.mesh for robot in run.world.robots.values()]
        self.iteration = self.outcome.seconds / iterations
        self.lost = 0
        """Connections that were made again."""
        if hasattr(meshes[0], "links"):
            states = [link for mesh in meshes for link in mesh.links().links]
            self.lost = sum(link.connection - 1 for link in states)


TRIED = [GRAPHS[0], *(pytest.param(graph, marks=pytest.mark.slow) for graph in GRAPHS[1:])]


@pytest.mark.parametrize("latency", ["1s", "3s"])
def test_a_mesh_forms_over_links_of_seconds_and_lockstep_goes_on_at_their_pace(latency):
    ran = Ran(("3", "line"), 20, "--latency", latency)
    assert ran.outcome.problems == ()
    assert ran.iteration <= 1.1 * float(latency[:-1])
    assert ran.lost == 0


@pytest.mark.parametrize("graph", TRIED)
@pytest.mark.parametrize(
    ("latency", "jitter", "bandwidth"),
    [
        (0.005, 1.0, 80_000),
        (0.2, 0.0, 2_000),
        (0.2, 1.0, 20_000),
        (1.0, 0.0, 80_000),
        (1.0, 1.0, 2_000),
        (3.0, 0.0, 2_000),
    ],
)
def test_no_plain_link_that_carries_is_given_up(graph, latency, jitter, bandwidth):
    links = ("--latency", f"{latency}s", "--jitter", f"{jitter * latency}s", "--bandwidth", f"{bandwidth}B",
             "--loss", "5%")  # fmt: skip
    iterations = 30
    model = Ran(graph, iterations, *links, "--mesh", "delay")
    ran = Ran(graph, iterations, *links)
    assert ran.outcome.problems == ()
    assert ran.lost == 0
    assert ran.iteration <= 1.3 * model.iteration


def test_way_of_a_value_is_a_tree_of_shortest_ways():
    line, hub = [("r0", "r1"), ("r1", "r2"), ("r2", "r3")], [("r0", "r1"), ("r0", "r2"), ("r0", "r3")]
    assert frames_of(line, line) == 6
    assert frames_of(line, hub) == 8
    assert ways_of(line, hub)["r2"] == {"r2": ("r0",), "r0": ("r1", "r3"), "r1": (), "r3": ()}


SHAPES = [*GRAPHS, ("6", "full")]
SLOTS = [
    pytest.param(graph, links, stay, marks=() if graph == GRAPHS[0] and stay in (0.05, 0.3) else pytest.mark.slow)
    for graph in SHAPES
    for links in ("graph", "star", "tree", "auto")
    for stay in (0.05, 0.1, 0.2, 0.3)
]


@pytest.mark.parametrize(("graph", "links", "stay"), SLOTS)
def test_no_link_of_the_slot_radio_that_carries_is_given_up(graph, links, stay):
    robots, shape = graph
    names = [f"r{place}" for place in range(int(robots))]
    edges = sorted(Graph.of_shape(shape, names).edges)
    own = links == "graph" or (links == "auto" and graph == GRAPHS[0])
    ways = sorted(callers(names, edges)) if own else physical(names, edges, links)
    iterations = 100
    ran = Ran(graph, iterations, "--radio", f"slots:stay={stay}", "--links", links)
    assert ran.outcome.problems == ()
    assert ran.lost == 0
    assert ran.outcome.messages <= 1.3 * frames_of(edges, ways) * (iterations + 1)
    model = [Exchange(edges, ways, SlotParameters(stay=stay), seed).paced(iterations) for seed in range(3)]
    assert pace(ran.moments.values()) <= 1.3 * fmean(model)


def test_more_robots_than_a_hub_serves_lose_no_link_and_send_little_more_than_needed():
    """A tree of two hubs, of which one is in two piconets."""
    names = [f"r{place}" for place in range(9)]
    edges = sorted(Graph.of_shape("loop", names).edges)
    ran = Ran(("9", "loop"), 100, "--radio", "slots:stay=0.3", "--links", "tree")
    assert ran.outcome.problems == ()
    assert ran.lost == 0
    assert ran.outcome.messages <= 1.3 * frames_of(edges, physical(names, edges, "tree")) * 101


HUBS = [("4", "full"), *(pytest.param(("6", shape), marks=pytest.mark.slow) for shape in ("thesis-d", "full"))]
SLOW = [
    ("--latency", "0.2s", "--jitter", "0.2s", "--bandwidth", "20kB", "--loss", "5%"),
    pytest.param(("--latency", "3s", "--bandwidth", "2kB", "--loss", "5%"), marks=pytest.mark.slow),
]


@pytest.mark.parametrize("graph", HUBS)
@pytest.mark.parametrize("links", SLOW, ids=["0.2s", "3s"])
def test_no_plain_link_of_a_hub_that_carries_is_given_up(graph, links):
    robots, shape = graph
    names = [f"r{place}" for place in range(int(robots))]
    edges = sorted(Graph.of_shape(shape, names).edges)
    iterations = 100  # until round trips are known, questions come too early
    ran = Ran(graph, iterations, *links, "--links", "star")
    model = Ran(graph, iterations, *links, "--mesh", "delay")
    assert ran.outcome.problems == ()
    assert ran.lost == 0
    assert ran.outcome.messages <= 1.3 * frames_of(edges, physical(names, edges, "star")) * (iterations + 1)
    assert ran.iteration <= 1.3 * 2 * model.iteration
