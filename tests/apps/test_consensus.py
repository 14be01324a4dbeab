"""The built-in consensus against the limits of the thesis' table 4.1 and the rounds known for each graph."""

import math

import pytest
from memory_swarm import THESIS_X0, MemorySwarm, config_of


def run(count: int, shape: str, algorithm: str, last: int) -> MemorySwarm:
    values = {f"r{i}": {"value": x} for i, x in enumerate(THESIS_X0[count])}
    return MemorySwarm("consensus", config_of(count, shape, "consensus", {"algorithm": algorithm}, values), last)


@pytest.mark.parametrize(
    ("count", "shape", "limit"),
    [(3, "line", 20 / 7), (6, "line", 41 / 16), (6, "loop", 15.5 / 6), (6, "thesis-d", 61.5 / 24)],
)
def test_rule_4_1_ends_on_the_degree_weighted_mean(count: int, shape: str, limit: float) -> None:
    swarm = run(count, shape, "thesis", 300)
    for result in swarm.final.values():
        assert result["value"] == pytest.approx(limit, abs=1e-12)


@pytest.mark.parametrize(("count", "shape"), [(3, "line"), (6, "line"), (6, "loop"), (6, "thesis-d"), (6, "full")])
def test_metropolis_ends_on_the_mean(count: int, shape: str) -> None:
    swarm = run(count, shape, "metropolis", 400)
    mean = sum(THESIS_X0[count]) / count
    for result in swarm.final.values():
        assert result["value"] == pytest.approx(mean, abs=1e-12)


@pytest.mark.parametrize(("shape", "rounds"), [("line", 58), ("loop", 13), ("thesis-d", 11), ("full", 1)])
def test_metropolis_needs_no_more_rounds_than_known(shape: str, rounds: int) -> None:
    """To 1e-2 of the mean at all robots."""
    swarm = run(6, shape, "metropolis", rounds)
    mean = sum(THESIS_X0[6]) / 6
    assert max(abs(result["value"] - mean) for result in swarm.final.values()) <= 1e-2


def test_one_message_per_neighbour_and_iteration() -> None:
    """2 E messages an iteration, the thesis needs 4 E."""
    assert run(6, "line", "metropolis", 50).messages == 2 * 5 * 51


def test_the_sum_is_kept() -> None:
    swarm = run(6, "thesis-d", "metropolis", 200)
    for k in range(201):
        total = math.fsum(states[k]["value"] for states in swarm.states.values())
        assert total == pytest.approx(15.5, abs=1e-12)
