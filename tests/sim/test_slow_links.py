"""No constant of time breaks on a slow link: links form, lockstep goes on as fast as the links let it, and no link is
given up that carries. Over plain links of every kind, and over the slot radio."""

import pytest

from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.virtual.run import PLACE, VirtualRun

GRAPHS = (("3", "line"), ("6", "line"), ("6", "loop"), ("6", "thesis-d"), ("4", "full"))


class Ran:
    """A run of consensus to its last iteration."""

    def __init__(self, graph, iterations, *more):
        robots, shape = graph
        options = parse(["consensus", "--virtual", "--robots", robots, "--topology", shape,
                         "--iterations", str(iterations), *more])  # fmt: skip
        run = VirtualRun(options, build(options, PLACE))
        self.outcome = run.go()
        meshes = [robot.mesh for robot in run.world.robots.values()]
        self.iteration = self.outcome.seconds / iterations
        self.lost = 0
        """Connections that were made again."""
        if hasattr(meshes[0], "links"):
            states = [link for mesh in meshes for link in mesh.links().links]
            self.lost = sum(link.connection - 1 for link in states)


TRIED = [GRAPHS[0], *(pytest.param(graph, marks=pytest.mark.slow) for graph in GRAPHS[1:])]


def needed(graph, iterations):
    """Messages of a run in which nothing is asked for."""
    robots, shape = graph
    n = int(robots)
    edges = {"line": n - 1, "loop": n, "thesis-d": 9, "full": n * (n - 1) // 2}[shape]
    return 2 * edges * (iterations + 1)


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


@pytest.mark.parametrize("graph", TRIED)
@pytest.mark.parametrize("stay", [0.05, 0.1, 0.2])
def test_no_link_of_the_slot_radio_that_carries_is_given_up(graph, stay):
    iterations = 100
    ran = Ran(graph, iterations, "--radio", f"slots:stay={stay}", "--links", "graph")
    assert ran.outcome.problems == ()
    assert ran.lost == 0
    assert ran.outcome.messages <= 1.3 * needed(graph, iterations)


HUBS = [("4", "full"), *(pytest.param(("6", shape), marks=pytest.mark.slow) for shape in ("thesis-d", "full"))]
SLOW = [
    ("--latency", "0.2s", "--jitter", "0.2s", "--bandwidth", "20kB", "--loss", "5%"),
    ("--latency", "3s", "--bandwidth", "2kB", "--loss", "5%"),
    ("--radio", "slots:stay=0.05"),
    ("--radio", "slots:stay=0.3"),
]


@pytest.mark.parametrize("graph", HUBS)
@pytest.mark.parametrize("radio", SLOW, ids=lambda radio: radio[1])
def test_no_link_of_a_hub_that_carries_is_given_up(graph, radio):
    iterations = 30
    ran = Ran(graph, iterations, *radio, "--links", "star")
    assert ran.outcome.problems == ()
    assert ran.lost == 0
    # Each robot but the hub tells its value once, and the hub gives each what its neighbours tell.
    assert ran.outcome.messages <= 1.5 * (needed(graph, iterations) + (int(graph[0]) - 1) * (iterations + 1))
    if radio[0] == "--latency":
        model = Ran(graph, iterations, *radio, "--mesh", "delay")
        assert ran.iteration <= 1.3 * 2 * model.iteration
