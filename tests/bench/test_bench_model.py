"""The discrete-event model that lockstep is measured against."""

import pytest

from bench.lockstep import lockstep
from bench.lockstep import model as lockstep_model
from bench.lockstep.model import Outage
from services.mesh.links.radio_model import AirModel
from swarm.core.graph import Graph

NAMES = tuple(f"r{index}" for index in range(6))


@pytest.mark.parametrize("shape", ["line", "loop", "thesis-d", "full"])
def test_without_jitter_an_iteration_takes_the_latency(shape: str) -> None:
    times = lockstep_model.run(Graph.of_shape(shape, NAMES), AirModel(0.03), 50)
    assert all(path[k] == pytest.approx(0.03 * k) for path in times.values() for k in range(51))


def test_jitter_costs_more_the_more_neighbours_there_are() -> None:
    air = AirModel(0.03, 0.01, seed=1)
    found = [
        lockstep_model.mean_iteration(lockstep_model.run(Graph.of_shape(shape, NAMES), air, 1000))
        for shape in ("line", "loop", "thesis-d", "full")
    ]
    # Two independent sums gave 37.4 to 38, 38.6 to 38.8, 41.4 to 42, 44.7 to 44.8 ms.
    assert found == pytest.approx([0.0377, 0.0387, 0.0417, 0.0447], rel=0.02)


def test_a_cut_holds_what_arrives_in_it_and_spreads_one_neighbour_an_iteration() -> None:
    times = lockstep_model.run(Graph.of_shape("line", NAMES[:3]), AirModel(0.03), 10, [Outage(("r0", "r1"), 0.05, 1.0)])
    assert times["r0"][1] == times["r1"][1] == pytest.approx(0.03)
    assert times["r0"][2] == times["r1"][2] == pytest.approx(1.05)
    assert times["r2"][2] == pytest.approx(0.06)
    assert times["r2"][3] == pytest.approx(1.08)


def test_a_cut_that_is_gone_around_holds_up_less() -> None:
    graph = Graph.of_shape("loop", NAMES[:4])
    times = lockstep_model.run(graph, AirModel(0.03), 10, [Outage(("r0", "r1"), 0.05, 1.0)], around_after=0.2)
    # Both ends look 0.2 s after 0.03, and hear of each other over three hops; so again three hops later, and so on.
    assert [times["r0"][k] for k in range(2, 10)] == pytest.approx([0.03 + 0.2 + 0.09 * k for k in range(1, 9)])
    assert times["r1"] == times["r0"]


def test_a_line_cannot_be_gone_around() -> None:
    graph, cuts = Graph.of_shape("line", NAMES), [Outage(("r2", "r3"), 0.05, 1.0)]
    assert lockstep_model.run(graph, AirModel(0.03), 50, cuts, around_after=0.2) == lockstep_model.run(
        graph, AirModel(0.03), 50, cuts
    )


def test_one_seed_gives_one_run() -> None:
    graph = Graph.of_shape("thesis-d", NAMES)
    runs = [lockstep_model.run(graph, AirModel(0.03, 0.01, seed=seed), 50) for seed in (1, 1, 2)]
    assert runs[0] == runs[1] != runs[2]


@pytest.mark.parametrize(
    ("shape", "robots", "latency", "code"),
    [("full", 6, 0.03, 0.301), ("line", 3, 0.03, 0.201), ("line", 3, 0.0, 0.201)],
)
def test_the_pattern_of_the_thesis_takes_what_its_code_took(
    shape: str, robots: int, latency: float, code: float
) -> None:
    assert lockstep.thesis_pattern(shape, NAMES[:robots], latency) == pytest.approx(code, rel=0.15)
