"""`swarm measure`: figures, ways through the swarm, and real meshes measured over each overlay."""

import json
from pathlib import Path

import pytest
from conftest import wait_until
from hypothesis import given
from hypothesis import strategies as st
from mesh_rig import Build, build
from test_mesh_command import LINE_OF_FOUR, known
from test_mesh_overlay_process import LINE, wait_here
from test_mesh_stop import Swarm, at, swarm

from swarm.errors import LocalError
from swarm.onboard.measure.figures import NEIGHBOURS, Figures, Series, of_bursts, of_times
from swarm.onboard.measure.links import code, path, table

__all__ = ["build", "swarm"]


# -- figures -----------------------------------------------------------------------------------------------------


def test_figures_follow_from_times_of_single_messages() -> None:
    found = of_times(500, [0.3, 0.1, 0.2], 5, both_ways=True)
    assert found == Figures(500, 3, 2, 0.1, 0.2, pytest.approx(0.2), pytest.approx(0.1), 0.3, pytest.approx(5000.0))
    assert of_times(500, [0.2], 1, both_ways=False).goodput == pytest.approx(2500.0)
    assert of_times(500, [], 4, both_ways=True) == Figures(500, 0, 4, *[None] * 6)


def test_figures_of_bursts_leave_the_latency_out() -> None:
    found = of_bursts(100, [[5.0, 5.1, 5.2], [9.2, 9.0, 9.1], [7.0]], 3)
    assert (found.samples, found.lost, found.goodput) == (2, 2, pytest.approx(1000.0))
    at_once = of_bursts(100, [[1.0, 1.0]], 2)
    assert at_once.goodput is None, "no time has passed between them"
    assert (code([Series(NEIGHBOURS, "r1", 1, (at_once,))]), at_once.lost) == (0, 0)
    assert table("r0", "throughput", [Series(NEIGHBOURS, "r1", 1, (at_once,))])[-1].endswith(" in one go")
    in_two_goes = [1.0, 1.0001, 1.0002, 2.0002, 2.0003]
    assert of_bursts(100, [in_two_goes], 5).goodput == pytest.approx(200.0, rel=0.001)


@given(st.lists(st.floats(1e-6, 1e3), min_size=1), st.integers(1, 1 << 20), st.integers(0, 5))
def test_figures_are_in_order(times: list[float], size: int, lost: int) -> None:
    found = of_times(size, times, len(times) + lost, both_ways=False)
    assert found.rtt_min <= found.rtt_median <= found.rtt_p99
    assert (found.samples, found.lost) == (len(times), lost)


# -- ways --------------------------------------------------------------------------------------------------------


def test_the_way_to_a_robot() -> None:
    assert path(LINE_OF_FOUR, "r0", "r1") == ["r1"]
    two_hops = LINE_OF_FOUR | {"r2": known("r2", {"r1": 0.04}, hops=2, via="r1")}
    assert path(two_hops, "r0", "r2") == ["r1", "r2"]


@pytest.mark.parametrize(
    ("peer", "text"),
    [
        ("r9", "there is no robot r9, there are r1 r2 r3"),
        ("r3", "no way from r0 to r3: it is gone"),
        ("r2", "has just changed"),
    ],
)
def test_no_way_is_said(peer: str, text: str) -> None:
    cut = LINE_OF_FOUR | {"r1": known("r1", {"r0": 0.03}), "r2": known("r2", {"r3": 0.1}, hops=2, via="r1")}
    with pytest.raises(LocalError, match=text):
        path(cut, "r0", peer)


# -- between real meshes -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_links_and_paths_are_measured_over_each_overlay(
    build: Build, swarm: Swarm, monkeypatch: pytest.MonkeyPatch, runtime: Path
) -> None:
    robots = build(edges=LINE, model="latency=0.005")
    robots.start()
    wait_here(robots)
    at(robots["r0"], monkeypatch)
    monkeypatch.setenv("MPLCONFIGDIR", str(runtime))
    wait_until(lambda: swarm("mesh")[0] == 0, what="the map is whole")

    def measure(*arguments: str) -> list[dict[str, object]]:
        code, text = swarm("measure", *arguments, "--json")
        assert code == 0, text
        found: list[dict[str, object]] = json.loads(text)["series"]
        return found

    plot = runtime / "rtt.png"
    (link,) = measure("rtt", "r1", "--count", "3", "--sizes", "50,1000", "--plot", str(plot))
    assert (link["overlay"], link["to"], link["hops"]) == ("neighbours", "r1", 1)
    assert [(each["size"], each["samples"], each["lost"]) for each in link["figures"]] == [(50, 3, 0), (1000, 3, 0)]
    assert all(each["rtt_min"] >= 0.01 for each in link["figures"])
    assert plot.stat().st_size > 5000
    # Without being told: neighbours for a link, unicast beyond.
    (way,) = measure("rtt", "r0", "r3", "--count", "3", "--sizes", "50")
    assert (way["overlay"], way["to"], way["hops"]) == ("unicast", "r3", 3)
    assert way["figures"][0]["rtt_min"] >= 0.03
    every = measure("rtt", "r0-r3", "--overlay", "all", "--count", "2", "--sizes", "100", "--plot", str(plot))
    assert [(each["overlay"], each["to"], each["hops"]) for each in every] == [
        ("neighbours", "r1", 1), ("unicast", "r1", 1), ("unicast", "r2", 2), ("unicast", "r3", 3),
        ("flood", "3 robots", 3),
    ]  # fmt: skip
    for overlay in ("neighbours", "unicast", "flood"):
        (one,) = measure("throughput", "r1", "--overlay", overlay, "--count", "1", "--sizes", "2000")
        assert one["figures"][0]["goodput"] > 1000
    for overlay in ("unicast", "flood"):
        (large,) = measure("rtt", "r3", "--overlay", overlay, "--count", "1", "--sizes", "50000", "--priority", "bulk")
        assert large["figures"][0]["samples"] == 1
    code, text = swarm("measure", "rtt", "r3", "--count", "1", "--sizes", "30")
    assert code == 0
    assert "unicast to r3, 3 hops: one message at a time, confirmed" in text
    for wrong, problem in (
        (("rtt", "r7"), "there is no robot r7"),
        (("rtt", "r3", "--overlay", "neighbours"), "r3 is not a neighbour"),
        (("rtt", "r3", "--sizes", "5000"), "a message has at most"),
        (("rtt", "r1", "--overlay", "flood", "--sizes", "5000"), "a flood has at most"),
        (("rtt", "r1", "r2"), "this is r0"),
        (("rtt", "r0"), "expected two robots"),
        (("rtt", "r1", "r2", "r3"), "from which robot to which"),
        (("rssi", "r1"), "this link has no radio"),
    ):
        code, text = swarm("measure", *wrong, "--count", "1")
        assert code == 2, text
        assert problem in text
