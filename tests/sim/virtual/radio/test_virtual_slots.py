"""`swarm sim --virtual --radio slots`: the services' own cores over a radio with piconets."""

from dataclasses import replace

import pytest
from iteration_moments import moments_of

from sim.report import summary
from sim.report_table import table
from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.virtual.run import PLACE, VirtualRun, run_virtually
from swarm.errors import ConfigError

CONSENSUS = ("consensus", "--robots", "3", "--topology", "line", "--set", "r2.value=4", "--iterations", "60")


def test_a_run_over_the_slot_radio_ends_with_the_same_bits_as_one_over_plain_links():
    plain, _ = run_virtually(*CONSENSUS)
    slots, _ = run_virtually(*CONSENSUS, "--radio", "slots")
    assert slots["problems"] == []
    assert slots["result"] == plain["result"]


def test_a_slot_run_is_reproducible_and_depends_on_its_seed():
    runs = [run_virtually(*CONSENSUS, "--radio", "slots", "--seed", seed)[0] for seed in ("1", "1", "2")]
    for run in runs:
        del run["computed_s"]
    assert runs[0] == runs[1]
    assert runs[0]["seconds"] != runs[2]["seconds"]


def test_a_cut_ends_a_link_of_the_slot_radio_and_it_comes_back():
    report, _ = run_virtually(*CONSENSUS, "--iterations", "200", "--radio", "slots", "--cut", "r0-r1@0.5s,8s")
    assert report["problems"] == []
    assert report["iterations"] == 200
    assert report["seconds"] > 8


def test_a_robot_that_comes_late_is_called_and_waited_for_over_the_slot_radio():
    report, _ = run_virtually(*CONSENSUS, "--radio", "slots", "--off", "r2@start,7s")
    assert report["problems"] == []
    assert report["iterations"] == 60


@pytest.mark.slow
def test_a_robot_that_was_absent_for_long_knocks_and_is_called_back():
    more = ("--radio", "slots", "--links", "star", "--absent", "drop", "--drop-after", "3", "--off", "r2@start,80s")
    options = parse([*CONSENSUS[:5], "--virtual", "--seconds", "120", *more])
    run = VirtualRun(options, build(options, PLACE))
    moments = moments_of(run, "r2")
    assert run.go().problems == ()
    # Nobody has called it since its third page, and would not before 100 s had passed. The first moment is its start.
    assert 80 < moments[1] < 110
    links = run.world.robots["r0"].mesh.links().links
    assert {link.peer: link.state for link in links} == {"r1": "up", "r2": "up"}


@pytest.mark.parametrize("seed", [0, 1])
def test_a_robot_that_was_absent_has_all_of_its_links_again_soon(seed):
    """Who calls it has taken it for absent. Its first link is back by a knock; it knocks at the other caller, too."""
    options = parse(
        ["consensus", "--virtual", "--robots", "5", "--topology", "line", "--radio", "slots", "--links", "graph",
         "--iterations", "20000", "--seed", str(seed)]
    )  # fmt: skip
    world = VirtualRun(options, build(options, PLACE)).world
    world.time.run(20.0)
    links = {link.peer: link.role for link in world.robots["r2"].mesh.links().links}
    assert links == {"r1": "peripheral", "r3": "peripheral"}
    for caller in links:
        world.air.cut(caller, "r2", 60.0)
    world.time.run(140.0)
    assert [link.state for link in world.robots["r2"].mesh.links().links] == ["up", "up"]


def noticed_after(happens, robot="r2", neighbour="r1"):
    """How long after `happens(world)` a neighbour's link with the robot is no longer up, s, and what it says."""
    options = parse([*CONSENSUS[:5], "--virtual", "--radio", "slots", "--iterations", "20000"])
    world = VirtualRun(options, build(options, PLACE)).world
    world.time.run(20.0)
    happens(world)
    while world.time.now < 60.0:
        (link,) = [link for link in world.robots[neighbour].mesh.links().links if link.peer == robot]
        if link.state not in ("up", "suspect"):
            return world.time.now - 20.0, link.reason, world
        world.time.run(world.time.now + 0.01)
    raise AssertionError("it is never noticed")


def test_a_power_cut_is_noticed_after_the_supervision_time_out_and_the_end_of_a_mesh_at_once():
    waited, _, _ = noticed_after(lambda world: world.kill_mesh("r2"))
    assert waited < 0.3
    waited, reason, world = noticed_after(lambda world: world.switch_off("r2", 8.0))
    assert 1.5 < waited < 3.0
    assert reason == "silent: the radio gave the link up"
    world.time.run(60.0)
    states = {name: {link.peer: link.state for link in each.mesh.links().links} for name, each in world.robots.items()}
    assert states["r1"] == {"r0": "up", "r2": "up"}
    assert states["r2"]["r1"] == "up"


@pytest.mark.parametrize("seconds", [0.05, 0.5, 1.5, 2.5])
@pytest.mark.parametrize("robot", ["r0", "r1", "r2"])
def test_a_robot_that_is_on_again_before_its_links_are_given_up_has_them_again(robot, seconds):
    options = parse([*CONSENSUS[:5], "--virtual", "--radio", "slots", "--iterations", "20000"])
    world = VirtualRun(options, build(options, PLACE)).world
    world.time.run(20.0)
    world.switch_off(robot, seconds)
    world.time.run(80.0)
    for name, each in world.robots.items():
        up = {link.peer for link in each.mesh.links().links if link.state == "up"}
        assert up >= set(world.config.neighbours(name)), name
    radio = world.air.radio
    for device in radio.devices.values():
        assert all(
            end.device is radio.devices[end.device.name]
            for link in device.links
            for end in (link.central, link.peripheral)
        )


def test_a_report_says_how_late_the_radio_of_real_processes_was():
    late = {"frames": 300, "late_mean_s": 0.0005, "late_most_s": 0.012, "stood_still_s": 2.0}
    outcome = replace(run_virtually(*CONSENSUS)[1], radio=late)
    report = summary(outcome)
    assert report["radio"] == late
    said = "radio       0.5 ms late on average, 12.0 ms at most, with 300 frames; it stood still for 2 s"
    assert said in table(report, outcome).splitlines()


@pytest.mark.parametrize(
    "more", [("--loss", "0.1"), ("--jitter", "10ms"), ("--bandwidth", "78kB"), ("--virtual", "--mesh", "delay")]
)
def test_what_contradicts_the_slot_radio_is_refused(more):
    with pytest.raises(ConfigError, match="--radio slots"):
        parse(["consensus", "--radio", "slots", *more])


@pytest.mark.parametrize("radio", ["waves", "slots:stay=0", "slots:colour=1"])
def test_another_radio_or_parameter_is_refused(radio, capsys):
    with pytest.raises(SystemExit):
        parse(["consensus", "--virtual", "--radio", radio])
    assert "--radio" in capsys.readouterr().err
