"""Eigenvalues of the weights against numpy's."""

import math

import numpy as np
import pytest
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st

from swarm.core import spectrum
from swarm.core.graph import Graph


def graph(count: int, shape: str) -> Graph:
    return Graph.of_shape(shape, [f"r{i}" for i in range(count)])


def matrix(graph: Graph) -> np.ndarray:
    w = np.zeros((len(graph.names), len(graph.names)))
    for i, name in enumerate(graph.names):
        for other, weight in graph.metropolis_weights(name).items():
            w[i, graph.names.index(other)] = weight
        w[i, i] = 1 - w[i].sum()
    return w


@costly(60)
@given(st.integers(2, 40), st.integers(0, 2**32))
def test_the_bounds_are_those_of_the_matrix(count: int, seed: int) -> None:
    random = graph(count, f"random:{seed}")
    values = np.linalg.eigvalsh(matrix(random))
    assert spectrum.bounds(random, "r0") == pytest.approx((values[0], values[-2]), abs=1e-9)


@pytest.mark.parametrize(("shape", "radius"), [("line", 0.911), ("loop", 0.667), ("thesis-d", 0.601), ("full", 0.0)])
def test_radii_of_the_thesis_graphs(shape: str, radius: float) -> None:
    low, high = spectrum.bounds(graph(6, shape), "r3")
    assert max(-low, high) == pytest.approx(radius, abs=5e-4)


def test_many_robots_are_estimated_from_within() -> None:
    """A line of 200: the largest eigenvalue is (1 + 2 cos(pi / 200)) / 3."""
    low, high = spectrum.bounds(graph(200, "line"), "r0")
    exact = (1 + 2 * math.cos(math.pi / 200)) / 3
    assert 0.999 * exact < high < exact + 1e-12
    assert low == pytest.approx((1 + 2 * math.cos(math.pi * 199 / 200)) / 3, abs=1e-3)


def test_each_connected_part_has_its_own() -> None:
    names = ["a", "b", "c", "d", "e"]
    parts = Graph(names, [("a", "b"), ("c", "d")])
    assert spectrum.bounds(parts, "a") == pytest.approx((0.0, 0.0), abs=1e-12)
    assert spectrum.bounds(parts, "d") == pytest.approx((0.0, 0.0), abs=1e-12)
    assert spectrum.bounds(parts, "e") == (0.0, 0.0)
    assert spectrum.bounds(Graph(["a", "b", "c"], [("a", "b"), ("b", "c")]), "b") == pytest.approx((0.0, 2 / 3))
