"""Routes by hops are Dijkstra's; a swarm that begins settled has no link states to tell but those that change."""

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from services.mesh.core.linkstate import HOLD_DOWN, HOPS, REFRESH, Known, LinkState
from services.mesh.core.packets import Advertisement
from services.mesh.core.routing import Edge, routes, routes_by_hops
from services.sim.virtual.run import simulate

NAMES = [f"r{i}" for i in range(9)]
PAIRS = [(a, b) for a in NAMES for b in NAMES if a < b]


@given(st.dictionaries(st.sampled_from(PAIRS), st.tuples(st.integers(1, 9), st.integers(1, 9), st.booleans())))
def test_levels_give_the_routes_that_dijkstra_gives(edges):
    """An edge that only one end tells of counts for neither."""
    told = {name: {} for name in NAMES}
    graph = {name: {} for name in NAMES}
    for (a, b), (there, back, both) in edges.items():
        told[a][b] = there
        if both or a == "r0":
            told[b][a] = back
            graph[a][b] = graph[b][a] = Edge(1, max(there, back))
    own = {peer: edge.time for peer, edge in graph["r0"].items()}
    expected = routes("r0", graph)
    found = routes_by_hops("r0", own, {name: links for name, links in told.items() if name != "r0"})
    assert found == expected
    assert list(found) == list(expected)


def map_of(published):
    return LinkState("r0", metric=HOPS, publish=published.append, aged=lambda name: None, random=lambda: 0.5)


def test_a_settled_robot_tells_nothing_until_something_changes():
    published = []
    each = map_of(published)
    others = {
        "r1": Known(1, Advertisement({"r0": 300, "r2": 300}), 0.0),
        "r2": Known(1, Advertisement({"r1": 300}), 0.0),
    }
    each.settle({"r1": 300}, others, 0.0)
    assert not each.routes()
    assert each.link_up("r1", 0.1) is False
    assert {name: route.hops for name, route in each.routes().items()} == {"r1": 1, "r2": 2}
    each.measured("r1", 0.06, 0.6)
    each.handle_timer(0.1 + HOLD_DOWN + 2.1)
    assert published == []
    each.handle_timer(REFRESH * 1.01)
    assert len(published) == 1
    each.link_down("r1", REFRESH * 1.02)
    assert len(published) == 2
    assert each.link_up("r1", REFRESH * 1.03) is True


def test_a_settled_swarm_computes_what_one_does_that_has_just_begun():
    arguments = ("consensus", "--robots", "12", "--topology", "random:3", "--iterations", "40")
    cold, first = simulate(*arguments, "--mesh", "start", rows=True)
    settled, second = simulate(*arguments, "--mesh", "settled", rows=True)
    assert {name: path.rows for name, path in first.trajectories.items()} == {
        name: path.rows for name, path in second.trajectories.items()
    }
    assert cold["messages_per_iteration"] == settled["messages_per_iteration"]


def test_in_a_settled_swarm_a_broken_link_is_told_and_floods_reach_all(tmp_path):
    app = tmp_path / "teller.py"
    app.write_text(
        "from swarm import EventApp\n\n\nclass Teller(EventApp):\n    heard: int\n    reached: int\n\n"
        "    def on_button(self, button):\n        self.robot.flood(b'x')\n\n"
        "    def on_message(self, message):\n        self.heard += 1\n\n"
        "    def on_answer(self, ticket, outcome):\n        self.reached = len(outcome.robots)\n"
    )
    report, _ = simulate(
        str(app), "--robots", "12", "--topology", "loop", "--mesh", "settled", "--seconds", "15",
        "--press", "r0.A@1s", "--cut", "r3-r4@2s,9s", "--press", "r5.A@8s",
    )  # fmt: skip
    assert report["problems"] == []
    assert report["result"]["r0"] == {"heard": 1, "reached": 11}
    assert report["result"]["r5"] == {"heard": 1, "reached": 11}
    assert Counter(result["heard"] for result in report["result"].values()) == {2: 10, 1: 2}
