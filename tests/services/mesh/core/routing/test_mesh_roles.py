"""Who calls whom: every link once, the same on all robots, one piconet where the graph has two sides."""

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.mesh.core.routing.physical_links import callers, calls_of, is_bluetooth, links_of, piconets, waiting
from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.virtual.run import PLACE
from swarm.core.graph import Graph


def graph(shape, n):
    return Graph.of_shape(shape, [f"r{number}" for number in range(n)])


@given(st.integers(3, 9), st.integers(0, 20))
def test_every_link_has_one_caller_and_turning_any_does_not_help(n, seed):
    found = graph(f"random:{seed}", n)
    calls = callers(found.names, found.edges)
    assert {frozenset(call) for call in calls} == {frozenset(edge) for edge in found.edges}
    assert len(calls) == len(found.edges)
    links = sorted(calls)
    assert waiting(links) <= waiting([(min(link), max(link)) for link in links])
    for place, (caller, called) in enumerate(links):
        assert waiting([*links[:place], (called, caller), *links[place + 1 :]]) >= waiting(links)


@pytest.mark.parametrize("shape", ["loop", "line", "full", *(f"random:{seed}" for seed in range(5))])
@pytest.mark.parametrize("n", [3, 4, 5])
def test_no_other_roles_make_waiting_shorter_on_small_graphs(shape, n):
    found = graph(shape, n)
    least = min(waiting([call[::way] for call, way in zip(found.edges, ways, strict=True)])
                for ways in product((1, -1), repeat=len(found.edges)))  # fmt: skip
    assert waiting(sorted(callers(found.names, found.edges))) == least


def test_on_a_full_graph_of_six_the_worst_link_is_between_robots_of_three_and_five_piconets():
    found = graph("full", 6)
    calls = sorted(callers(found.names, found.edges))
    assert waiting(calls) == (15, 165)  # the least of all 2^15, and (20, 161) by turning single calls alone
    assert sorted(piconets(calls).values()) == [3, 3, 3, 3, 3, 5]


@given(st.integers(3, 9), st.integers(0, 20), st.randoms(use_true_random=False))
def test_all_robots_find_the_same_in_whatever_order_links_are_written(n, seed, random):
    found = graph(f"random:{seed}", n)
    names, edges = list(found.names), [edge[:: random.choice((1, -1))] for edge in found.edges]
    random.shuffle(names)
    random.shuffle(edges)
    assert callers(names, edges) == callers(found.names, found.edges)


@pytest.mark.parametrize(("shape", "n", "most"), [("line", 3, 1), ("line", 6, 2), ("loop", 6, 2), ("thesis-d", 6, 3)])
def test_graphs_of_the_thesis_need_few_piconets(shape, n, most):
    found = graph(shape, n)
    assert max(piconets(sorted(callers(found.names, found.edges))).values()) <= most


def test_the_hub_of_a_star_calls():
    names = [f"r{number}" for number in range(6)]
    assert callers(names, [("r0", name) for name in names[1:]]) == {("r0", name) for name in names[1:]}
    assert callers(names, [(name, "r5") for name in names[:5]]) == {("r5", name) for name in names[:5]}


@pytest.mark.parametrize("virtual", [(), ("--virtual",)])
@pytest.mark.parametrize("links", ["graph", "tree"])
def test_on_a_simulated_radio_robots_call_as_on_a_real_one(virtual, links):
    options = parse(
        ["consensus", "--robots", "4", "--topology", "loop", "--links", links, "--radio", "slots", *virtual]
    )
    config = build(options, PLACE).config
    assert is_bluetooth(config)
    assert links_of(config) == links
    if links == "graph":  # one side calls the other
        assert calls_of(config) == callers(config.names, config.edges)
        assert max(piconets(list(calls_of(config))).values()) == 2
    else:
        assert ("r0", "r3") in calls_of(config)


def test_the_delays_of_plain_links_are_no_radio():
    config = build(parse(["consensus", "--robots", "4", "--topology", "loop"]), PLACE).config
    assert not is_bluetooth(config)
    assert links_of(config) == "graph"
    assert calls_of(config) == ()
