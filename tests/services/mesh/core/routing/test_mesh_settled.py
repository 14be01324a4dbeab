"""Routes by hops are Dijkstra's; a swarm that begins settled has no link states to tell but those that change."""

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from services.mesh.core.overlays.members import MEMBERS_PERIOD
from services.mesh.core.overlays.robot_overlays import RobotOverlays
from services.mesh.core.routing.link_state import HOLD_DOWN, HOPS, REFRESH, AdvertisedLinks, LinkStateMap
from services.mesh.core.routing.membership import SETTLE
from services.mesh.core.routing.topology import Advertisement, Weight, routes, routes_by_hops
from sim.virtual.run import run_virtually

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
            graph[a][b] = graph[b][a] = Weight(1, max(there, back))
    own = {peer: edge.time for peer, edge in graph["r0"].items()}
    expected = routes("r0", graph)
    found = routes_by_hops("r0", own, {name: links for name, links in told.items() if name != "r0"})
    assert found == expected
    assert list(found) == list(expected)


def map_of(published):
    return LinkStateMap(
        "r0",
        frozenset(NAMES),
        metric=HOPS,
        publish=published.append,
        aged=lambda name: None,
        returned=lambda name: None,
        random=lambda: 0.5,
    )


def test_a_settled_robot_tells_nothing_until_something_changes():
    published = []
    each = map_of(published)
    others = {
        "r1": AdvertisedLinks(1, Advertisement({"r0": 300, "r2": 300}), 0.0),
        "r2": AdvertisedLinks(1, Advertisement({"r1": 300}), 0.0),
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


def settled_loop(size, *, without=()):
    """The overlays of a loop of robots that begin settled, links and what floods they send carried by hand."""
    names = [f"r{i}" for i in range(size)]
    links = {name: {names[i - 1]: 300, names[(i + 1) % size]: 300} for i, name in enumerate(names)}
    known = {name: AdvertisedLinks(1, Advertisement(near), 0.0) for name, near in links.items()}
    bots = {}
    for name in names:
        bots[name] = RobotOverlays(name, frozenset(names), incarnation=1, random=lambda: 0.5, counters=Counter())
        bots[name].settle(links, known, 0.0)
    for a, near in links.items():
        for b in near:
            if frozenset((a, b)) not in without:
                assert bots[a].link_up(b, 0.1)
    return bots, links, known


def states(overlays, now):
    return {each.robot: each.state for each in overlays.members(now).members}


def test_settled_robots_share_one_map_until_it_changes():
    bots, _, known = settled_loop(6)
    for now in (0.1, SETTLE + MEMBERS_PERIOD, REFRESH / 2):
        for each in bots.values():
            each.handle_timer(now)
            assert each._map._known is known
    assert states(bots["r0"], 30.0) == dict.fromkeys(("r1", "r2", "r3", "r4", "r5"), "here")
    assert [each.hops for each in bots["r0"].members(30.0).members] == [1, 2, 3, 2, 1]
    assert {each.robot: tuple(each.links) for each in bots["r0"].graph(30.0).robots}["r3"] == ("r2", "r4")
    bots["r0"].link_down("r1", 30.0)
    assert bots["r0"]._map._known is not known
    assert bots["r1"]._map._known is known
    assert "r0" in known
    assert [each.hops for each in bots["r0"].members(30.0).members] == [5, 4, 3, 2, 1]


def test_who_vanishes_together_from_a_settled_swarm_is_a_part_of_it():
    bots, _, _ = settled_loop(6)
    for peer in ("r1", "r5"):
        bots["r0"].link_down(peer, 5.0)
    bots["r0"].handle_timer(5.0 + SETTLE)
    assert {each.robot: each.what for each in bots["r0"].members(6.0).changes} == dict.fromkeys(
        ("r1", "r2", "r3", "r4", "r5"), "partition"
    )
    assert set(states(bots["r0"], 6.0).values()) == {"gone"}


def test_a_robot_of_a_settled_swarm_whose_links_never_come_up_notices_that():
    alone = {frozenset(("r0", "r1")), frozenset(("r0", "r5"))}
    bots, _, _ = settled_loop(6, without=alone)
    bots["r0"].handle_timer(SETTLE + MEMBERS_PERIOD)
    assert set(states(bots["r0"], 12.0).values()) == {"gone"}


def test_a_settled_swarm_computes_what_one_does_that_has_just_begun():
    arguments = ("consensus", "--robots", "12", "--topology", "random:3", "--iterations", "40")
    cold, first = run_virtually(*arguments, "--mesh", "start", rows=True)
    settled, second = run_virtually(*arguments, "--mesh", "settled", rows=True)
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
    report, _ = run_virtually(
        str(app), "--robots", "12", "--topology", "loop", "--mesh", "settled", "--seconds", "15",
        "--press", "r0.A@1s", "--cut", "r3-r4@2s,9s", "--press", "r5.A@8s",
    )  # fmt: skip
    assert report["problems"] == []
    assert report["result"]["r0"] == {"heard": 1, "reached": 11}
    assert report["result"]["r5"] == {"heard": 1, "reached": 11}
    assert Counter(result["heard"] for result in report["result"].values()) == {2: 10, 1: 2}
