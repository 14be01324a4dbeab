"""Changes of a run's members under virtual time: who stays away is waited for, or dropped and taken in again; what a
run keeps and records are the iterations that count."""

import json
import subprocess
import sys

import pytest
from conftest import thinned

from sim.scenario.options import parse
from sim.scenario.scenario import build
from sim.virtual.run import PLACE, VirtualRun, run_virtually
from swarm.core.epochs.actions import EpochRequest
from swarm.errors import ConfigError
from swarm.messages import SetAppEpoch
from swarm.messages.keys import key
from swarm.recording.run import Run as Recorded

LOOP = ("consensus", "--robots", "5", "--topology", "loop")
DROP = ("--absent", "drop", "--drop-after", "2")
AWAY = ("--cut", "r0-r1@0.5s,10s", "--cut", "r1-r2@0.5s,10s")


def values(outcome, name):
    return outcome.trajectories[name].rows


@pytest.fixture(scope="module")
def undisturbed():
    return run_virtually(*LOOP, "--iterations", "100", rows=True)


def test_by_default_a_robot_that_is_cut_off_is_waited_for(undisturbed):
    report, outcome = run_virtually(*LOOP, "--iterations", "100", *AWAY, rows=True)
    assert report["problems"] == []
    assert report["iterations"] == 100
    assert report["seconds"] > 10
    assert all(values(outcome, name) == values(undisturbed[1], name) for name in outcome.trajectories)


def test_a_robot_that_is_cut_off_is_dropped_and_the_others_go_on(tmp_path):
    report, outcome = run_virtually(*LOOP, "--seconds", "9", *DROP, *AWAY, "--record", str(tmp_path), rows=True)
    assert report["problems"] == []
    last = {name: path.last for name, path in outcome.trajectories.items()}
    assert last["r1"] < 30
    assert min(k for name, k in last.items() if name != "r1") > 100
    recorded = Recorded(tmp_path)
    assert {name: path.rows for name, path in recorded.trajectories().items()} == {
        name: path.rows for name, path in outcome.trajectories.items()
    }


def test_a_robot_that_is_cut_off_for_ever_is_named_at_the_end():
    cut = ("--cut", "r0-r1@0.5s,999s", "--cut", "r1-r2@0.5s,999s")
    report, _ = run_virtually(*LOOP, "--iterations", "60", *DROP, *cut)
    assert report["missing"] == ["r1"]
    assert report["iterations"] == 60


@pytest.mark.parametrize("drop_after", ["0.3", "0.6"])
def test_a_robot_is_taken_in_again_where_robots_are_dropped_sooner_than_they_repeat_their_notes(drop_after):
    away = ("--absent", "drop", "--drop-after", drop_after, "--off", "r0@1s,1.6s")
    report, _ = run_virtually("consensus", "--robots", "3", "--iterations", "60", *away)
    assert report["problems"] == []
    assert report["missing"] == []


def test_a_robot_that_comes_back_is_taken_in_with_its_value(tmp_path):
    report, outcome = run_virtually(*LOOP, "--seconds", "20", *DROP, *AWAY, "--record", str(tmp_path), rows=True)
    assert report["problems"] == []
    ends = {name: path.last for name, path in outcome.trajectories.items()}
    assert max(ends.values()) - min(ends.values()) <= 2
    k = min(ends.values())
    finals = [outcome.trajectories[name].value(k, "value") for name in ends]
    assert max(finals) - min(finals) < 1e-6
    recorded = Recorded(tmp_path)
    assert {name: path.rows for name, path in recorded.trajectories().items()} == {
        name: path.rows for name, path in outcome.trajectories.items()
    }


def test_a_run_of_so_many_iterations_ends_without_the_robot_that_was_dropped():
    away = ("--cut", "r0-r1@0.5s,1000s", "--cut", "r1-r2@0.5s,1000s")
    report, outcome = run_virtually(*LOOP, "--iterations", "100", *DROP, *away)
    assert report["problems"] == []
    assert [path.last == 100 for path in outcome.trajectories.values()] == [True, False, True, True, True]
    assert report["seconds"] < 15


@pytest.mark.parametrize("mesh", thinned(["start", "settled", "delay"]))
def test_a_robot_that_reboots_is_taken_in_again_from_its_first_state(mesh):
    report, outcome = run_virtually(
        *LOOP, "--seconds", "20", *DROP, "--off", "r3@1s,6s", "--mesh", mesh, "--set", "r3.value=9", rows=True
    )
    assert report["problems"] == []
    ends = {name: path.last for name, path in outcome.trajectories.items()}
    assert max(ends.values()) - min(ends.values()) <= 2
    path = outcome.trajectories["r3"]
    gap = [k for k in range(path.last) if k not in path.rows]
    assert len(gap) > 50
    assert path.value(gap[-1] + 1, "value") == 9.0
    assert gap == list(range(gap[0], gap[-1] + 1))


def test_a_robot_that_reboots_is_waited_for_in_vain_where_nobody_may_be_dropped():
    report, _ = run_virtually(*LOOP, "--iterations", "200", "--off", "r3@1s,2s")
    (problem,) = report["problems"]
    assert "r3 has lost its state and waits for the next epoch" in problem


def test_a_robot_that_comes_late_is_waited_for(undisturbed):
    report, outcome = run_virtually(*LOOP, "--iterations", "100", "--off", "r3@start,7s", rows=True)
    assert report["problems"] == []
    assert all(values(outcome, name) == values(undisturbed[1], name) for name in outcome.trajectories)


def test_a_robot_that_comes_late_is_taken_in_where_the_others_have_begun():
    report, outcome = run_virtually(*LOOP, "--seconds", "20", *DROP, "--off", "r3@start,7s", rows=True)
    assert report["problems"] == []
    ends = {name: path.last for name, path in outcome.trajectories.items()}
    assert max(ends.values()) - min(ends.values()) <= 2
    assert min(ends.values()) > 200
    path = outcome.trajectories["r3"]
    assert path.times[min(k for k in path.rows if k > 0)] > 7


def test_times_count_from_the_first_iteration_of_all_where_all_robots_come_late():
    late = [f"--off=r{i}@start,{1 + 2 * i}s" for i in range(3)]
    _, outcome = run_virtually("consensus", "--robots", "3", "--topology", "loop", "--seconds", "5", *late, rows=True)
    firsts = [min(time for k, time in path.times.items() if k > 0) for path in outcome.trajectories.values()]
    assert outcome.started_s is not None
    assert outcome.started_s == max(firsts) > 5


def test_a_fault_stops_nobody_else_where_robots_may_be_dropped(tmp_path):
    app = tmp_path / "bad.py"
    app.write_text(
        "from swarm import SyncApp\n\n\nclass Bad(SyncApp):\n    value: float\n\n"
        "    def step(self, neighbours):\n        self.value = 1.0 / (3 - self.k) if self.robot.name == 'r1' else 0.0\n"
    )
    report, outcome = run_virtually(str(app), "--robots", "5", "--topology", "loop", "--iterations", "50", *DROP)
    (problem,) = report["problems"]
    assert "r1" in problem
    assert "iteration 3" in problem
    assert [path.last for path in outcome.trajectories.values()] == [50, 3, 50, 50, 50]


def test_an_operator_sends_a_robot_away_and_lets_it_come_back():
    options = parse([*LOOP, "--virtual", "--seconds", "12"])
    run = VirtualRun(options, build(options, PLACE), rows=True)
    world, epochs = run.world, []

    def order(ticket, drop=(), add=()):
        wish = SetAppEpoch(ticket, drop, add, force=False)
        world.robots["r0"].meshes_bus.publish(key("r0", "app/consensus", "set", "epoch"), wish)

    world.robots["r2"].meshes_bus.subscribe(
        key("r2", "app/consensus", "epoch"), lambda name, payload: epochs.append(payload)
    )
    world.time.at(3.0, order, "one", ("r1",))
    world.time.at(7.0, order, "two", (), ("r1",))
    outcome = run.go()
    assert outcome.problems == ()
    assert len(epochs) == 2
    path = outcome.trajectories["r1"]
    assert any(k not in path.rows for k in range(path.last))
    assert abs(path.last - outcome.trajectories["r3"].last) <= 2


@pytest.mark.slow
def test_changes_of_members_are_the_same_bytes_whatever_the_hashes_are(tmp_path):
    def files(name, salt):
        disturbed = (*DROP, "--jitter", "10ms", "--off", "r3@1s,5s", "--cut", "r0-r1@2s,3s")
        command = [
            sys.executable,
            "-m",
            "laptop.cli.runs.sim",
            *LOOP,
            "--virtual",
            "--seconds",
            "14",
            *disturbed,
            "--json",
        ]
        command += ["--record", str(tmp_path / name)]
        environment = {"PYTHONHASHSEED": salt, "PATH": "", "PYTHONPATH": ":".join(sys.path)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        assert json.loads(done.stdout)["problems"] == []
        return {path.name: path.read_bytes() for path in sorted((tmp_path / name).iterdir())}

    assert files("a", "1") == files("b", "2")


def test_a_robot_that_is_none_cannot_be_switched_off():
    with pytest.raises(ConfigError, match="--off r9@1s,2s: the robots are r0"):
        run_virtually(*LOOP, "--off", "r9@1s,2s")


def test_a_lone_robot_goes_on_at_its_pace_after_a_change_of_members():
    """A step that was planned in the epoch before is void: it was done beside the new epoch's, at twice the pace."""
    options = parse(
        ["consensus", "--robots", "1", "--seconds", "6", "--absent", "drop", "--drop-after", "2", "--virtual"]
    )
    run = VirtualRun(options, build(options, PLACE))
    time, robot = run.world.time, run.world.robots["r0"]
    time.at(3.0, lambda: robot.apps["consensus"].drivers[""].request(EpochRequest()))
    outcome = run.go()
    times = outcome.trajectories["r0"].times
    assert max(times) == pytest.approx(6 / 0.03, rel=0.05)
    ks = sorted(times, key=times.get)
    assert ks == sorted(ks)


@pytest.mark.parametrize("absent", [(), DROP])
def test_the_locksteps_of_an_event_driven_app_hear_the_links_in_force_where_they_may_drop_a_robot(absent):
    options = parse(["led_sync", "--robots", "3", "--seconds", "3", *absent, "--virtual"])
    run = VirtualRun(options, build(options, PLACE))
    run.go()
    assert run.world.robots["r0"].meshes_bus.wanted(key("r0", "mesh", "topology")) == bool(absent)


def test_a_run_that_has_not_converged_at_its_last_iteration_says_so_once():
    words = ("consensus", "--robots", "3", "--until", "converged", "--rounds", "2")
    report, _ = run_virtually(*words, "--iterations", "9")
    assert report["problems"] == ["not converged within 9 iterations"]
    assert run_virtually(*words, "--tolerance", "1e-2", "--iterations", "99")[0]["problems"] == []
    assert run_virtually(*words, "--for", "0.2s")[0]["problems"] == []


def test_an_app_that_has_finished_is_no_problem(tmp_path):
    app = tmp_path / "arrives.py"
    app.write_text(
        "from swarm import PeriodicApp\n\n\nclass Arrives(PeriodicApp):\n    x: float\n    period = 0.1\n\n"
        "    def step(self, neighbours):\n        self.finish('all have arrived')\n"
    )
    report, _ = run_virtually(str(app), "--robots", "2", "--iterations", "50")
    assert (report["problems"], report["iterations"]) == ([], 1)


def test_an_error_in_converged_is_the_apps_fault(tmp_path):
    app = tmp_path / "unsure.py"
    app.write_text(
        "from swarm import SyncApp\n\nclass Unsure(SyncApp):\n    value: float\n\n    def step(self, neighbours):\n"
        "        self.value += 1\n\n    def converged(self):\n        return 1 / (self.k - 3)\n"
    )
    report, _ = run_virtually(str(app), "--robots", "2", "--until", "converged")
    assert any("ZeroDivisionError" in problem for problem in report["problems"])
