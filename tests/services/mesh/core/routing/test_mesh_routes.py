"""The map of the swarm: routes are shortest and agree, and link states are told in time and seldom."""

import networkx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from overlay_world import World

from services.mesh.core.routing import link_state, topology
from services.mesh.core.routing.link_state import HOPS, TIME, Level, LinkStateMap
from services.mesh.core.routing.topology import Advertisement, Weight, encode_advertisement, routes


@given(st.integers(2, 12), st.data())
def test_routes_are_shortest_and_agree(n: int, data: st.DataObject) -> None:
    pairs = [(i, j) for i in range(n) for j in range(i + 1, n)]
    chosen = data.draw(st.lists(st.sampled_from(pairs), unique=True))
    graph: dict[str, dict[str, Weight]] = {f"r{i}": {} for i in range(n)}
    reference = networkx.Graph()
    reference.add_nodes_from(graph)
    for i, j in chosen:
        cost = data.draw(st.integers(1, 5))
        graph[f"r{i}"][f"r{j}"] = graph[f"r{j}"][f"r{i}"] = Weight(cost, 10 * cost)
        reference.add_edge(f"r{i}", f"r{j}", weight=cost)
    tables = {name: routes(name, graph) for name in graph}
    for name, table in tables.items():
        lengths = networkx.single_source_dijkstra_path_length(reference, name)
        assert {to: route.cost for to, route in table.items()} == {
            to: cost for to, cost in lengths.items() if to != name
        }
        for to, route in table.items():
            assert route.time == 10 * route.cost
            assert tables[to][name].hops == route.hops
            at, hops = name, 0
            while at != to:
                at, hops = tables[at][to].next_hop, hops + 1
                assert hops <= n, "in circles"
            assert hops <= route.hops


@pytest.mark.parametrize(("metric", "expected"), [(HOPS, ["r2", "r0"]), (TIME, ["r1", "r2", "r1", "r0"])])
def test_a_fast_detour_beats_a_slow_hop_where_time_is_the_metric(metric: str, expected: list[str]) -> None:
    edges = [("r0", "r1"), ("r1", "r2"), ("r0", "r2")]
    world = World(edges, metric=metric)
    world.latencies[frozenset(("r0", "r2"))] = 0.2
    world.settle()
    for a, b in edges:
        rtt = 2 * world.latencies.get(frozenset((a, b)), 0.03)
        for name, peer in ((a, b), (b, a)):
            world.step(name, lambda each, peer=peer, rtt=rtt: each.measured(peer, rtt, world.now))
    world.settle()
    hops: list[str] = []
    world.watch = lambda sender, peer, packet: hops.append(peer)
    world.send("r0", "r2", b"x")
    world.run(0.5)
    assert hops == expected


@given(st.lists(st.floats(0.0, 20.0), min_size=1))
def test_times_go_in_steps_with_hysteresis(times: list[float]) -> None:
    level = Level()
    for seconds in times:
        before = level.time
        changed = level.measured(seconds)
        assert changed or level.time == before
        assert 1 <= level.time <= 65535
        clipped = min(max(seconds * 1e4, 1.0), 6.0e4)
        assert 0.8 * clipped - 1 <= level.time <= 1.25 * clipped + 1
    assert not level.measured(times[-1])


def advertise(**neighbours: int) -> bytes:
    return encode_advertisement(Advertisement(neighbours))


def linkstate_of(name: str) -> tuple[LinkStateMap, list[bytes], list[str]]:
    published: list[bytes] = []
    aged: list[str] = []
    robots = frozenset(f"r{n}" for n in range(9))
    each = LinkStateMap(
        name,
        robots,
        metric=HOPS,
        publish=published.append,
        aged=aged.append,
        returned=lambda _: None,
        random=lambda: 0.5,
    )
    return each, published, aged


def run(each: LinkStateMap, start: float, end: float) -> None:
    while each.next_deadline() <= end:
        each.handle_timer(max(start, each.next_deadline()))
    each.handle_timer(end)


def test_an_edge_counts_only_if_both_ends_report_it() -> None:
    each, _, _ = linkstate_of("r0")
    each.link_up("r1", 0.0)
    each.receive("r1", 1, advertise(r0=300, r2=300), 0.1)
    assert set(each.routes()) == {"r1"}
    each.receive("r2", 1, advertise(r1=300), 0.2)
    assert set(each.routes()) == {"r1", "r2"}
    each.receive("r1", 1, advertise(r2=300), 0.3)
    run(each, 0.3, link_state.TRUSTED + 0.1)
    assert set(each.routes()) == set(), "r1 has given the link up, we have not noticed yet"


def test_good_news_wait_bad_news_do_not_and_both_are_rare() -> None:
    each, published, _ = linkstate_of("r0")
    for n in range(7):
        each.link_up(f"r{n + 1}", 0.01 * n)
    run(each, 0.06, 0.19)
    assert not published
    run(each, 0.19, 0.3)
    assert len(published) == 1
    each.link_down("r1", 1.0)
    assert len(published) == 2
    for n in range(100):
        each.link_up("r1", 2.0 + n * 0.1)
        run(each, 2.0 + n * 0.1, 2.05 + n * 0.1)
        each.link_down("r1", 2.05 + n * 0.1)
    assert len(published) <= 2 + link_state.BURST + 11
    run(each, 12.0, 20.0)
    assert "r1" not in topology.decode_advertisement(published[-1]).neighbours


def test_link_states_are_refreshed_and_old_ones_dropped() -> None:
    each, published, aged = linkstate_of("r0")
    each.link_up("r1", 0.0)
    each.receive("r1", 1, advertise(r0=300), 0.1)
    run(each, 0.1, 601.0)
    assert 10 <= len(published) <= 12
    assert aged == ["r1"]
    assert each.advertised("r1") is None
