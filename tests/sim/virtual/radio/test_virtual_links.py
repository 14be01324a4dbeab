"""Links that are not the topology's own: the same bits, the same neighbours, and successors of a hub, under virtual
time."""

from itertools import pairwise
from pathlib import Path

import pytest
from conftest import thinned
from iteration_moments import moments_of

from bench.radio.swarm import SIZE, fail_over, transfer
from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.virtual.run import PLACE, VirtualRun, run_virtually
from swarm.errors import ConfigError

SIX = ("consensus", "--robots", "6", "--topology", "thesis-d")
DROP = ("--absent", "drop", "--drop-after", "3")


def rows(outcome):
    return {name: path.rows for name, path in outcome.trajectories.items()}


@pytest.fixture(scope="module")
def graph():
    return rows(run_virtually(*SIX, "--iterations", "60", rows=True)[1])


@pytest.mark.parametrize("radio", [(), ("--radio", "slots")])
@pytest.mark.parametrize("links", ["star", "auto"])
def test_what_carries_a_topology_changes_no_bit_of_a_run(graph, links, radio):
    report, outcome = run_virtually(*SIX, "--iterations", "60", "--links", links, *radio, rows=True)
    assert report["problems"] == []
    assert rows(outcome) == graph


def test_more_robots_than_a_hub_has_links_for_are_carried_by_several_hubs():
    many = ("consensus", "--robots", "11", "--topology", "loop", "--iterations", "30")
    report, outcome = run_virtually(*many, "--links", "tree", rows=True)
    assert report["problems"] == []
    assert rows(outcome) == rows(run_virtually(*many, rows=True)[1])


@pytest.mark.parametrize("app", ["led_sync", "localization"])
def test_apps_of_other_kinds_run_over_a_star(app):
    arguments = (app, "--robots", "4", "--topology", "line", "--seconds", "3")
    report, _ = run_virtually(*arguments, "--links", "star")
    assert report["problems"] == []
    assert report["iterations"] == pytest.approx(run_virtually(*arguments)[0]["iterations"], rel=0.6)


def world(*arguments):
    options = parse([*arguments, "--virtual"])
    return VirtualRun(options, build(options, PLACE)).world


def test_a_robot_has_the_topologys_neighbours_and_the_hubs_links():
    there = world("--robots", "5", "--topology", "line", "--links", "star", "--seconds", "9")
    there.time.run(5.0)
    told = {name: robot.mesh.look(lambda overlays, now: overlays.topology(now)) for name, robot in there.robots.items()}
    assert {each.links for each in told.values()} == {tuple(("r0", f"r{place}") for place in range(1, 5))}
    assert told["r2"].wanted == told["r2"].up == ("r1", "r3")
    assert told["r2"].kept == ()
    assert [link.peer for link in there.robots["r2"].mesh.links().links] == ["r0"]
    assert told["r0"].edges[0] == ("r0", "r1")


def test_a_cut_of_a_hubs_link_holds_a_run_up_and_changes_nothing(graph):
    report, outcome = run_virtually(*SIX, "--iterations", "60", "--links", "star", "--cut", "r0-r2@0.5s,4s", rows=True)
    assert report["problems"] == []
    assert report["seconds"] > 4
    assert rows(outcome) == graph


def test_a_cut_between_two_robots_that_the_hub_joins_costs_nothing():
    quiet, _ = run_virtually(*SIX, "--iterations", "60", "--links", "star")
    cut, _ = run_virtually(*SIX, "--iterations", "60", "--links", "star", "--cut", "r1-r2@0.5s,4s")
    assert cut["seconds"] == quiet["seconds"]


SILENT = [word for place in range(1, 6) for word in ("--cut", f"r0-r{place}@1s,14s")]


@pytest.mark.parametrize(
    ("lost", "most"),
    [
        pytest.param(["--off", "r0@1s,14s", "--seconds", "26"], 10, id="off"),
        pytest.param([*SILENT, "--seconds", "26"], 10, id="silent", marks=pytest.mark.slow),
        # The hub's robots lose it by the supervision time-out, which is 11 s while round trips of the start count.
        pytest.param(
            ["--radio", "slots", "--off", "r0@1s,30s", "--seconds", "55"], 20, id="slots", marks=pytest.mark.slow
        ),
    ],
)
def test_when_the_hub_is_lost_the_others_go_on_without_it_and_with_it_when_it_is_back(lost, most):
    options = parse([*SIX, *DROP, "--virtual", "--latency", "100ms", "--links", "star", *lost])
    run = VirtualRun(options, build(options, PLACE))
    moments = moments_of(run, "r1")
    outcome = run.go()
    assert outcome.problems == ()
    assert 2 < max(after - before for before, after in pairwise(moments)) < most
    ends = {name: path.last for name, path in outcome.trajectories.items()}
    assert max(ends.values()) - min(ends.values()) <= 2  # r0, too
    topology = run.world.robots["r1"].mesh.look(lambda overlays, now: overlays.topology(now))
    assert topology.kept == ()


@pytest.mark.parametrize("seed", thinned([0, 1]))
def test_successors_of_a_hub_lost_just_after_the_start_are_not_called_by_who_knocks_at_it(seed):
    assert 2 < fail_over("thesis-d 6", seed) < 14  # with the supervision time-out, by which the hub is lost


@pytest.mark.slow
def test_lockstep_takes_at_most_twice_as_long_beside_a_large_message_on_the_slot_radio():
    quiet, busy, took = transfer("thesis-d 6", 90.0, 0, SIZE)
    assert quiet < busy <= 2 * quiet
    assert took < 60


@pytest.mark.parametrize("radio", [("--links", "star"), ("--radio", "slots")])
def test_a_robot_out_of_the_hubs_range_is_reached_over_another_one(radio):
    """Also by `links = auto`, which makes a star on the slot radio."""
    there = world("consensus", "--robots", "4", "--topology", "full", *radio, "--iterations", "20000")
    there.air.cut("r0", "r3", 100.0)
    there.time.run(60.0)
    assert "r3" in [link.peer for link in there.robots["r1"].mesh.links().links if link.state == "up"]
    topology = there.robots["r0"].mesh.look(lambda overlays, now: overlays.topology(now))
    assert topology.up == ("r1", "r2", "r3")


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--robots", "9", "--links", "star"), 'expected "tree" for 9 robots'),
        (("--topology", "auto", "--links", "star"), "finds links itself"),
        (("--links", "star", "--mesh", "delay", "--virtual"), "made by meshes from their start"),
    ],
)
def test_links_that_cannot_be_are_refused(more, words):
    options = parse(["consensus", *more])
    with pytest.raises(ConfigError, match=words):
        VirtualRun(options, build(options, Path("/virtual")))
