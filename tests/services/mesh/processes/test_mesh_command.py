"""`swarm mesh`: what is known from one robot and from many, put together, printed and drawn."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import wait_until
from mesh_rig import Build, build
from test_mesh_overlay_process import LINE, wait_here
from test_mesh_stop import Swarm, at, swarm

from laptop.cli import mesh as mesh_command
from laptop.cli.mesh import places
from swarm.core.graph import Graph
from swarm.errors import LocalError
from swarm.messages import Clock, GraphRobot, Links, LinkState, MeasuredHub, Topology
from swarm.onboard.mesh import show, tables
from swarm.onboard.mesh.collected import CollectedMesh, MeshView

__all__ = ["build", "swarm"]


def link(peer: str, state: str = "up", rtt: float | None = 0.06) -> LinkState:
    return LinkState(peer, state, 1, rtt, 5, 5, "" if state == "up" else "host is down", rtt, rtt, rtt)


def view(*links: LinkState, hop: int = 0) -> MeshView:
    return MeshView(Links(1.0, links), Clock(1.0, 0.0, 0.0, "r0", hop, 0.0012), {"flood_sent": 7, "refused_key": 2})


def known(name: str, links: dict[str, float], state: str = "here", **changes: object) -> GraphRobot:
    return replace(GraphRobot(name, state, 0.0, 1, "r1", links, None), **changes)


LINE_OF_FOUR = {
    "r0": known("r0", {"r1": 0.03}, "self", hops=0, via=None, stopped=True),
    "r1": known("r1", {"r0": 0.03, "r2": 0.025}),
    "r2": known("r2", {"r1": 0.04, "r3": 0.05}),
    "r3": known("r3", {}, "gone", hops=None, via=None),
}


def test_one_robot_knows_all_and_tells_what_it_measured_from_what_it_heard() -> None:
    found = CollectedMesh({"r0": view(link("r1", rtt=0.061))}, LINE_OF_FOUR)
    assert found.round_trips == {("r0", "r1"): 0.061, ("r1", "r2"): pytest.approx(0.08)}
    assert not found.whole
    text = tables.text(found)
    assert text[1].split() == ["r0", "self", "0", "1", "yes", "r0+0", "±1.2", "ms"]
    assert text[2].split() == ["r1", "here", "1", "r1", "2", "-"]
    assert text[4].split() == ["r3", "gone", "0", "-"]
    matrix = tables.graph(found)
    assert matrix[1].split() == ["r0", ".", "61.0", "-", "-"]
    assert matrix[2].split() == ["r1", "61.0", ".", "80.0", "-"]
    assert matrix[-1] == (
        "4 robots, 2 of 2 links up, median round trip 70.5 ms; 2 parts: r0 r1 r2; r3; away: r3 (gone)"
    )


def test_where_hubs_carry_the_topology_its_neighbours_are_named() -> None:
    edges = (("r0", "r1"), ("r1", "r2"), ("r2", "r3"))
    told = Topology(1.0, 0, 0, "", False, 0.0, edges, ("r1",), ("r1",), (), {}, (("r0", "r1"), ("r0", "r2")))
    asked = view(link("r1"), link("r2"))
    asked.topology = told
    assert tables.graph(CollectedMesh({"r0": asked}))[-1] == ("neighbours r0-r1 r1-r2 r2-r3, over hubs: r0 calls r1 r2")
    asked.topology = replace(told, links=())
    assert "hubs" not in tables.graph(CollectedMesh({"r0": asked}))[-1]


def test_the_hub_that_was_measured_is_named_with_the_round_trips_that_chose_it() -> None:
    edges = (("r0", "r1"), ("r1", "r2"))
    told = Topology(1.0, 0, 0, "", False, 0.0, edges, ("r1",), ("r1",), (), {}, (("r0", "r1"), ("r0", "r2")))
    asked, hub = view(link("r1")), view(link("r0"))
    asked.topology = replace(told, hub=MeasuredHub("r0", None, "", None, trial=False))
    mesh = CollectedMesh({"r2": asked})
    assert "hub by measurement: r0, mean round trip not known; no other was tried" in tables.graph(mesh)
    choice = MeasuredHub("r1", None, "r0", 0.194, trial=True)
    asked.topology = replace(told, step=1, hub=choice)
    hub.topology = replace(asked.topology, hub=replace(choice, round_trip=0.041))
    mesh = CollectedMesh({"r0": asked, "r1": hub})
    line = "hub by measurement: r1 (on trial), mean round trip 41.0 ms; before it r0, 194.0 ms"
    assert line in tables.graph(mesh)
    assert show.as_json(mesh)["hub"] == {"robot": "r1", "round_trip": 0.041, "before": "r0", "round_trip_before": 0.194,
                                    "trial": True}  # fmt: skip


def test_a_robot_out_of_its_hubs_range_is_named_with_the_reason_and_with_the_robot_that_calls_it_instead() -> None:
    links = (("r0", "r1"), ("r0", "r2"), ("r0", "r3"))
    told = Topology(1.0, 0, 0, "", False, 0.0, (("r0", "r3"),), ("r3",), ("r3",), (), {}, links)
    hub, bridge = view(link("r1"), link("r2", "down", None), link("r3", "down", None)), view(link("r0"), link("r3"))
    hub.topology = told
    assert tables.graph(CollectedMesh({"r0": hub, "r1": bridge}))[-2:] == [
        "no link r0-r2 (host is down): nothing leads to r2 instead",
        "no link r0-r3 (host is down): r3 has a link with r1 instead",
    ]


def test_a_link_counts_where_both_ends_tell_of_it_and_nobody_says_it_is_down() -> None:
    robots = LINE_OF_FOUR | {"r1": known("r1", {"r0": 0.03})}
    assert set(CollectedMesh({}, robots).round_trips) == {("r0", "r1")}
    found = CollectedMesh({"r0": view(link("r1", "down", None))}, LINE_OF_FOUR)
    assert found.states == {("r0", "r1"): False, ("r1", "r2"): True}
    assert not found.whole
    whole = {name: replace(robot, state="here") for name, robot in LINE_OF_FOUR.items() if name != "r3"}
    assert CollectedMesh({"r0": view(link("r1"))}, whole).whole


def test_the_tables_show_every_link_and_counter_of_those_who_were_asked() -> None:
    found = CollectedMesh(
        {"r0": view(link("r1")), "r1": view(link("r0"), link("r2", "down", None), hop=1), "r2": MeshView()}
    )
    text = "\n".join(tables.text(found))
    assert "r0+1 ±1.2 ms" in text
    assert "host is down" in text
    assert tables.robots(found)[3].split()[:2] == ["r2", "silent"]
    assert tables.overlays(found)[1].split() == ["r0", "7", *["0"] * 9, "2"]
    assert tables.graph(found)[-1] == "3 robots, 1 of 2 links up, median round trip 60.0 ms; 2 parts: r0 r1; r2"
    shown = show.as_json(found)
    assert shown["parts"] == [["r0", "r1"], ["r2"]]
    assert shown["edges"] == [{"ends": ["r0", "r1"], "round_trip": 0.06}]
    json.dumps(shown)


def test_roles_are_shown_where_links_have_them_and_a_wrong_one_is_said() -> None:
    right = replace(link("r1"), role="central", wanted_role="central")
    wrong = replace(link("r2"), role="peripheral", wanted_role="central")
    text = tables.links(CollectedMesh({"r0": view(right, wrong)}))
    assert [line.split("  ")[-1].strip() for line in text] == ["reason", "central", "peripheral, wanted central"]
    assert "role" in text[0]
    assert "role" not in tables.links(CollectedMesh({"r0": view(link("r1"))}))[0]


def test_a_large_swarm_is_a_list() -> None:
    names = [f"r{number:02}" for number in range(20)]
    found = CollectedMesh(
        {name: view(*(link(peer) for peer in names if abs(int(peer[1:]) - int(name[1:])) == 1)) for name in names}
    )
    graph = tables.graph(found)
    assert graph[1] == "r01: r00 60.0, r02 60.0"
    assert graph[-1].endswith("19 of 19 links up, median round trip 60.0 ms, diameter 19")


@pytest.mark.parametrize("shape", ["line", "loop", "full"])
@pytest.mark.parametrize("count", [1, 2, 6, 30])
def test_each_robot_has_a_place_of_its_own(shape: str, count: int) -> None:
    pytest.importorskip("numpy")
    graph = Graph.of_shape(shape if count > 2 else "line", [f"r{number}" for number in range(count)])
    if shape == "full" and count > 12:
        return  # no plane has room for so many equal distances; nothing is wrong with places on top of each other
    where = places(graph)
    assert len({(round(x, 3), round(y, 3)) for x, y in where.values()}) == count


def test_a_long_line_is_drawn_as_one() -> None:
    pytest.importorskip("numpy")
    where = places(Graph.of_shape("line", [f"r{number:02}" for number in range(20)]))
    main = [y for _, y in where.values()]
    assert main in (sorted(main), sorted(main, reverse=True))


def test_from_one_robot_the_whole_swarm_is_seen(
    build: Build, swarm: Swarm, monkeypatch: pytest.MonkeyPatch, runtime: Path
) -> None:
    robots = build(edges=LINE, model="latency=0.005")
    robots.start()
    wait_here(robots)
    at(robots["r1"], monkeypatch)
    wait_until(lambda: swarm("mesh")[0] == 0, what="all is well")
    monkeypatch.setenv("MPLCONFIGDIR", str(runtime))
    plot = runtime / "mesh.png"
    code, text = swarm("mesh", "--json", "--plot", str(plot))
    assert code == 0, text
    shown = json.loads(text)
    assert [edge["ends"] for edge in shown["edges"]] == [["r0", "r1"], ["r1", "r2"], ["r2", "r3"]]
    assert all(edge["round_trip"] >= 0.008 for edge in shown["edges"])
    assert {name: robot["hops"] for name, robot in shown["robots"].items()} == {"r0": 1, "r1": 0, "r2": 1, "r3": 2}
    assert shown["robots"]["r1"]["counters"]["flood_sent"] > 0
    assert plot.stat().st_size > 5000
    with pytest.raises(LocalError, match=r"nowhere/x\.png"):
        mesh_command.run(argparse_of(runtime / "nowhere/x.png"))
    robot = robots["r3"]
    assert robot.mesh is not None
    robot.mesh.kill()
    wait_until(lambda: "away: r3 (gone)" in swarm("mesh")[1], what="it is seen that one is gone")
    assert swarm("mesh")[0] == 1


def argparse_of(plot: Path) -> "show.argparse.Namespace":
    return show.argparse.Namespace(run_dir=None, robots=None, radio=False, json=True, plot=plot)
