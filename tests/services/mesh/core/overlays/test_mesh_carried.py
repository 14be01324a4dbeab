"""A topology that links of others carry: which links those are, who calls lost robots, and where values go."""

from collections import Counter
from collections.abc import Mapping

import networkx as nx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.mesh.core.link.calls import EAGER, OTHERS_SHARE, Search
from services.mesh.core.overlays.carried import Carried, Carrier, decode_carried, encode_carried, limit_of
from services.mesh.core.relay import KeyRelay
from services.mesh.core.routing.physical_links import BRIDGE, FLEETING, PAUSE, UNSEEN, Succession, calls, physical
from services.mesh.core.routing.topology import routes_by_hops
from services.mesh.core.wire.frames import BULK, MAX_MESSAGE, MAX_PAYLOAD, SYNC
from swarm.config.types import DEFAULT_RELAY, GRAPH, STAR, TREE

KEY = "swarm/{}/app/x/sync/c"


def names_of(count: int) -> list[str]:
    return [f"r{place:02}" for place in range(count)]


# -- which links there are -------------------------------------------------------------------------------------


@given(st.integers(1, 60))
def test_a_tree_has_one_way_between_any_two_robots_and_no_robot_more_links_than_a_radio_holds(count: int) -> None:
    tree = nx.Graph(physical(names_of(count), (), TREE))
    tree.add_nodes_from(names_of(count))
    assert nx.is_tree(tree)
    assert max(degree for _, degree in tree.degree) <= 7


@given(st.integers(2, 8))
def test_up_to_eight_robots_have_one_hub_the_first_which_calls_all(count: int) -> None:
    names = names_of(count)
    assert physical(names, (), STAR) == tuple((names[0], name) for name in names[1:])
    assert set(physical(names, (), STAR)) <= set(calls(names))


def test_the_graph_is_carried_by_its_own_links() -> None:
    assert physical(names_of(3), (("r00", "r02"),), GRAPH) == (("r00", "r02"),)


# -- who calls whom that is lost -------------------------------------------------------------------------------


def test_the_first_successor_calls_the_lost_ones_and_the_next_leave_it_to_the_first() -> None:
    names = names_of(4)
    first, second = Succession(names, "r01"), Succession(names, "r02")
    assert first.due(["r02", "r03"], set(), 0.0) == []
    assert first.due([], {"r00", "r02", "r03"}, 1.0) == []
    assert second.due([], {"r00", "r01", "r03"}, 1.0) == []
    assert first.due(["r02", "r03"], set(), 50.0) == []
    assert second.due(["r03"], set(), 50.0) == []
    assert first.next_deadline() == 50.0 + PAUSE
    assert second.next_deadline() == 50.0 + 2 * PAUSE
    assert first.due(["r02", "r03"], set(), 50.0 + PAUSE) == ["r02", "r03"]
    assert second.due(["r03"], {"r01"}, 50.0 + 2 * PAUSE) == []
    assert second.due(["r03"], {"r01"}, 50.0 + 2 * PAUSE + BRIDGE) == ["r03"]


def test_a_robot_that_was_never_there_is_left_to_its_hub_for_longer() -> None:
    first, second = Succession(names_of(4), "r01"), Succession(names_of(4), "r02")
    assert first.due(["r03"], set(), 0.0) == second.due(["r03"], {"r00", "r01"}, 0.0) == []
    assert first.next_deadline() == UNSEEN + PAUSE
    assert first.due(["r03"], {"r00"}, UNSEEN + PAUSE) == ["r03"]
    assert second.due(["r03"], {"r00", "r01"}, UNSEEN + 2 * PAUSE) == []
    assert second.due(["r03"], {"r00", "r01"}, UNSEEN + 2 * PAUSE + BRIDGE) == ["r03"]


def test_old_news_of_ways_that_the_lost_hub_had_begin_no_new_wait() -> None:
    succession = Succession(names_of(4), "r01")
    succession.due([], {"r00", "r02", "r03"}, 0.0)
    assert succession.due(["r02", "r03"], set(), 50.0) == []
    assert succession.due(["r03"], {"r02"}, 50.0 + PAUSE) == ["r03"]
    assert succession.due([], {"r02", "r03"}, 51.0 + PAUSE) == []
    assert succession.due(["r02"], {"r03"}, 51.5 + PAUSE) == ["r02"]
    assert succession.due([], {"r02", "r03"}, 52.0 + PAUSE) == []
    assert succession.due([], {"r02", "r03"}, 52.0 + PAUSE + FLEETING) == []
    assert succession.due(["r02"], {"r03"}, 60.0 + FLEETING) == []


# -- where values go -------------------------------------------------------------------------------------------


class Swarm:
    """Carriers whose links take no time."""

    def __init__(self, links: nx.Graph, neighbours: nx.Graph) -> None:
        self.names = sorted(links.nodes)
        self.counters: Counter[str] = Counter()
        self.delivered: list[tuple[str, str, bytes]] = []
        self.crossed: list[tuple[str, str]] = []
        """Links and directions that packets took."""
        told: Mapping[str, dict[str, int]] = {name: dict.fromkeys(links[name], 300) for name in self.names}
        self.routes = {name: routes_by_hops(name, told[name], told) for name in self.names}
        self.carriers = {name: self._carrier(name, sorted(neighbours[name])) for name in self.names}

    def _carrier(self, name: str, near: list[str]) -> Carrier:
        relay = KeyRelay(name, near, DEFAULT_RELAY, self.names)

        def emit(packet: object) -> None:
            peer, _, key, payload, priority, _ = packet  # type: ignore[misc]
            self.crossed.append((name, peer))
            assert self.carriers[peer].admits(key)
            self.carriers[peer].receive(name, key, payload, priority)

        return Carrier(
            name, self.names,
            emit=emit, route=self.routes[name].get, admits=relay.admits_neighbour, passes=relay.carries,
            deliver=lambda key, payload, priority: self.delivered.append((name, key, payload)), counters=self.counters,
        )  # fmt: skip


def swarms() -> st.SearchStrategy[tuple[nx.Graph, nx.Graph]]:
    """Links that reach everybody, not only trees, and who is whose neighbour."""

    def made(count: int, seed: int, more: float) -> tuple[nx.Graph, nx.Graph]:
        links = nx.random_labeled_tree(count, seed=seed)
        links.add_edges_from(nx.gnp_random_graph(count, more, seed=seed).edges)
        graph = nx.gnp_random_graph(count, 0.5, seed=seed + 1)
        names = dict(enumerate(names_of(count)))
        return nx.relabel_nodes(links, names), nx.relabel_nodes(graph, names)

    return st.builds(made, st.integers(2, 12), st.integers(0, 999), st.sampled_from((0.0, 0.2, 0.6)))


@given(swarms())
def test_each_neighbour_gets_a_value_once_and_no_link_carries_it_twice(graphs: tuple[nx.Graph, nx.Graph]) -> None:
    links, graph = graphs
    swarm = Swarm(links, graph)
    for name in swarm.names:
        swarm.delivered.clear()
        swarm.crossed.clear()
        swarm.carriers[name].send(KEY.format(name), b"x", SYNC, graph[name], latest=False)
        got = [(robot, payload) for robot, _, payload in swarm.delivered]
        refused = swarm.counters["carried_refused"]
        assert sorted(got) == [(robot, b"x") for robot in sorted(graph[name])] or refused
        assert len(set(swarm.crossed)) == len(swarm.crossed)
    if nx.is_tree(links):
        assert not swarm.counters["carried_refused"]
    assert not swarm.counters["carried_expired"]


@given(swarms(), st.integers(0, 2**16), st.integers(0, 255), st.randoms(use_true_random=False))
def test_whatever_a_neighbour_sends_ends_and_appears_only_where_its_robot_is_a_neighbour(
    graphs: tuple[nx.Graph, nx.Graph], robots: int, ttl: int, random: object
) -> None:
    links, graph = graphs
    swarm = Swarm(links, graph)
    me, liar = random.choice(list(links.edges))  # type: ignore[attr-defined]
    origin = random.choice([name for name in swarm.names if name != me])  # type: ignore[attr-defined]
    swarm.carriers[me].receive(liar, KEY.format(origin), encode_carried(Carried(robots, b"x", ttl)), SYNC)
    assert len(swarm.crossed) <= 2 * len(links.edges)
    for robot, _, _ in swarm.delivered:
        assert robot in graph[origin]
    if swarm.routes[me][origin].next_hop != liar:
        assert not swarm.delivered
        assert swarm.counters["carried_refused"] == 1


def test_a_robot_at_the_end_of_a_star_speaks_for_nobody_else_and_the_hub_can() -> None:
    star = nx.Graph([("r00", "r01"), ("r00", "r02")])
    swarm = Swarm(star, nx.complete_graph(["r00", "r01", "r02"]))
    lie = encode_carried(Carried(0b101, b"lie", 9))
    swarm.carriers["r00"].receive("r01", KEY.format("r02"), lie, SYNC)
    assert swarm.delivered == []
    swarm.carriers["r01"].receive("r00", KEY.format("r02"), encode_carried(Carried(0b010, b"lie", 9)), SYNC)
    assert swarm.delivered == [("r01", KEY.format("r02"), b"lie")]


def test_a_packet_whose_hops_are_used_up_and_one_without_a_way_are_counted() -> None:
    line = nx.Graph([("r00", "r01"), ("r01", "r02")])
    line.add_node("r03")
    swarm = Swarm(line, nx.complete_graph(sorted(line.nodes)))
    swarm.carriers["r01"].receive("r00", KEY.format("r00"), encode_carried(Carried(0b110, b"x", 1)), SYNC)
    assert [robot for robot, _, _ in swarm.delivered] == ["r01"]
    swarm.carriers["r00"].send(KEY.format("r00"), b"x", SYNC, ["r03"], latest=False)
    assert swarm.counters == {"carried_expired": 1, "carried_no_route": 1}


@pytest.mark.parametrize("key", ["swarm/r01/app/x/set/y", "swarm/r01/dwm/pose", "swarm/r09/app/x/sync/c", "r01/x"])
def test_a_channel_is_only_for_keys_of_neighbours(key: str) -> None:
    swarm = Swarm(nx.Graph([("r00", "r01")]), nx.Graph([("r00", "r01")]))
    assert not swarm.carriers["r00"].admits(key)
    assert not swarm.carriers["r00"].admits(KEY.format("r00"))
    assert swarm.carriers["r00"].admits(KEY.format("r01"))


@pytest.mark.parametrize("priority", [SYNC, BULK])
def test_the_longest_value_fits_with_its_head(priority: int) -> None:
    robots = names_of(60)
    longest = bytes(limit_of(priority, robots))
    data = encode_carried(Carried((1 << 60) - 1, longest, 32))
    assert len(data) <= (MAX_MESSAGE if priority == BULK else MAX_PAYLOAD)
    assert decode_carried(data).payload == longest


def test_several_callers_of_a_robot_that_stays_away_spend_little_time_on_it_together() -> None:
    search, now, spent = Search(lambda: 0.5, callers=6), 0.0, 0.0
    search.aim(["r05"], [], now)
    while now < 36_000.0:
        now = max(now, search.next_deadline())
        assert search.take(now) == "r05"
        now += 5.12  # a page that nobody answers
        spent += 5.12
        search.ended("r05", now)
    assert 6 * (spent - EAGER * 5.12) / now < 1.05 * OTHERS_SHARE
