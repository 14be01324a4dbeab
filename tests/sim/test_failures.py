"""Failures as part of an experiment: for every kind of app, by time and by seed, and told when they did not happen."""

import re
from pathlib import Path

import fork_server
import pytest
from conftest import thinned

from bench.rigs.simulation import Simulation
from sim.disturbances import Cut, Off, drawn, parsed_cut, parsed_off
from sim.virtual.run import run_virtually
from swarm import load
from swarm.errors import ConfigError, RecordingError
from swarm.recording.folder import OUTCOME_FILE
from swarm.recording.run import Run

BODIES = {
    "SyncApp": "    def step(self, neighbours):\n        self.n += 1\n",
    "PeriodicApp": "    def step(self, neighbours):\n        self.n += 1\n",
    "EventApp": """
    def start(self):
        self.robot.after(0.1, 'x')
    def on_timer(self, name):
        self.n += 1
        self.robot.after(0.1, 'x')
""",
}
FAILURES = (
    "--off",
    "r1@2s,3s",
    "--kill",
    "r2.app@3s",
    "--kill",
    "r0.mesh@4s",
    "--push",
    "r3@1s,0.6",
    "--cut",
    "r0-r1@6s,1s",
)


@pytest.mark.parametrize("kind", thinned(BODIES))
def test_every_kind_of_app_goes_through_failures(tmp_path: Path, kind: str) -> None:
    app = f"from swarm import {kind}\nclass Mine({kind}):\n    n: int = 0\n{BODIES[kind]}"
    (tmp_path / "mine.py").write_text(app)
    swarm = (str(tmp_path / "mine.py"), "--robots", "4", "--topology", "loop", "--seconds", "16", "--absent", "drop")
    report, outcome = run_virtually(*swarm, *FAILURES, "--latency", "0.1", "--record", str(tmp_path / "run"), rows=True)
    assert report["problems"] == []
    assert report["never"] == []
    assert outcome.restarts == {"r0": 1, "r1": 1, "r2": 1, "r3": 0}
    recorded = Run(tmp_path / "run")
    paths = recorded.trajectories()
    assert recorded.damage == []
    for name, path in paths.items():
        anew = kind != "SyncApp" and name in ("r1", "r2")
        assert len(path.breaks) == anew
        assert (path.rows, path.breaks) == (outcome.trajectories[name].rows, outcome.trajectories[name].breaks)
        # The time of a path never goes back, and all that a robot did before it was away is still there.
        times = [path.times[k] for k in sorted(path.times)]
        assert times == sorted(times)
        assert path.value(path.last, "n") > (70 if anew else 100 if kind != "SyncApp" else 50)
        assert not anew or path.value(path.breaks[0] - 1, "n") > 10
    (fault,) = (sample.message for sample in recorded.samples("swarm/r3/balancer/fault"))
    assert fault["name"] == "fell"


def test_a_killed_lockstep_app_goes_on_from_its_snapshot_to_the_same_bits() -> None:
    swarm = ("consensus", "--robots", "4", "--topology", "loop", "--iterations", "120")
    _, plain = run_virtually(*swarm, rows=True)
    report, outcome = run_virtually(*swarm, "--kill", "r1.app@1s", "--kill", "any.mesh@2s..3s", rows=True)
    assert report["restarts"] == 2
    assert {name: path.rows for name, path in outcome.trajectories.items()} == {
        name: path.rows for name, path in plain.trajectories.items()
    }


def test_a_push_throws_a_robot_over_only_where_it_is_hard_enough() -> None:
    for impulse, lies in (("0.2", False), ("0.6", True), ("-0.6", True)):
        _, outcome = run_virtually(
            "stand_up",
            "--lying",
            "back",
            "--press",
            "r0.A@0s",
            "--robots",
            "2",
            "--seconds",
            "9",
            "--push",
            f"r1@7s,{impulse}",
        )
        assert (outcome.scene["lies"] == ["r1"]) == lies


def test_what_never_happened_is_named() -> None:
    report, _ = run_virtually(
        "consensus", "--robots", "3", "--iterations", "50", "--cut", "r0-r1@5s,60s", "--kill", "r0.app@1s"
    )
    (never,) = report["never"]
    assert never.startswith("--cut r0-r1@5s,60s: the run ended 1.")


ABSENT = (
    *("consensus", "--robots", "5", "--topology", "full", "--seconds", "6", "--absent", "drop", "--drop-after", "1"),
    *("--off", "r2@0.5s,60s", "--off", "r1@start,90s", "--cut", "r0-r2@1s,60s", "--cut", "r0-r1@50s,1s"),
    *("--kill", "r2.app@1.5s", "--kill", "r1.mesh@1.5s", "--kill", "r0.mesh@1s", "--kill", "r0.mesh@1.05s"),
    *("--press", "r2.A@1.5s", "--push", "r1@1.5s"),
)
NEVER = {
    "--kill r2.app@1.5s: the robot was switched off then",
    "--kill r1.mesh@1.5s: the robot was switched off then",
    "--kill r0.mesh@1.05s: the service did not run then",
    "--press r2.A@1.5s: the robot was switched off then",
    "--push r1@1.5s,0.1: the robot was switched off then",
    "--off r1@start,90s: the run ended 6 s after its first iteration, before r1 came",
    "--cut r0-r1@50s,1s: the run ended 6 s after its first iteration",
}


def test_a_robot_may_be_switched_off_just_after_its_mesh_was_killed() -> None:
    report, _ = run_virtually(
        *("consensus", "--robots", "4", "--seconds", "9", "--absent", "drop", "--drop-after", "1s"),
        *("--kill", "r2.mesh@1s", "--off", "r2@1.1s,5s"),
    )
    assert report["problems"] == []
    assert report["never"] == []


def test_a_robot_that_is_still_off_when_the_run_ends_has_not_come() -> None:
    report, _ = run_virtually(
        *("consensus", "--robots", "3", "--topology", "full", "--seconds", "12", "--absent", "drop"),
        *("--drop-after", "1", "--off", "r1@start,10s", "--off", "r1@2s,40s"),
    )
    (never,) = report["never"]
    assert never.startswith("--off r1@start,10s")


def test_acts_on_a_robot_that_is_off_and_a_robot_that_never_came_are_named_under_virtual_time() -> None:
    report, outcome = run_virtually(*ABSENT)
    assert set(report["never"]) == NEVER
    assert len(report["never"]) == len(NEVER)
    assert outcome.bodies["r1"].tilt == 0.0


@pytest.mark.slow
def test_acts_on_a_robot_that_is_off_and_a_robot_that_never_came_are_named_between_processes() -> None:
    with Simulation(*ABSENT, program=("laptop.cli.runs.sim",), start=fork_server.start) as simulation:
        named = {
            re.sub(r"ended (?:[6-9]|\d\d+)\.\d+ s", "ended 6 s", sentence) for sentence in simulation.finish()["never"]
        }
    assert named == NEVER


def test_the_recording_of_real_processes_keeps_what_came_out_of_the_run() -> None:
    words = ("consensus", "--robots", "2", "--iterations", "5", "--cut", "r0-r1@600s,1s")
    with Simulation(*words, program=("laptop.cli.runs.sim",), start=fork_server.start) as simulation:
        report = simulation.finish()
        run = load(simulation.records)
        assert len(run.never) == 1
        assert (list(run.never), list(run.problems)) == (report["never"], report["problems"])
        assert (run.messages, run.closest) == (report["messages"], report["scene"]["closest_m"])
        (simulation.records / OUTCOME_FILE).write_text("{")
        with pytest.raises(RecordingError, match=OUTCOME_FILE):
            _ = load(simulation.records).never


def test_a_late_robot_that_is_switched_off_comes_when_it_is_on_again() -> None:
    late = ("--off", "r2@start,4s", "--off", "r2@1s,6s")
    report, outcome = run_virtually(
        "consensus", "--robots", "3", "--seconds", "12", "--absent", "drop", "--drop-after", "0.5", *late
    )
    assert (report["never"], report["missing"]) == ([], [])
    assert outcome.trajectories["r2"].last > 0


def test_the_seed_draws_times_and_robots() -> None:
    asked = [parsed_off("any@2s..8s,10s"), parsed_off("r1@1s,1s")]
    names = ("r0", "r1", "r2", "r3")
    assert drawn(asked, names, 1) == drawn(asked, names, 1)
    found = {drawn(asked, names, seed)[0] for seed in range(40)}
    assert {each.robot for each in found} == set(names)
    assert len({each.at for each in found}) == 40
    assert all(each.at is not None and 2.0 <= each.at <= 8.0 for each in found)
    assert drawn(asked, names, 7)[1] == Off("r1", 1.0, 1.0)
    with pytest.raises(ConfigError, match="--off r9@1s,1s: the robots are r0, r1"):
        drawn([parsed_off("r9@1s,1s")], names, 1)


def test_the_services_of_virtual_time_are_named() -> None:
    with pytest.raises(ConfigError, match="under virtual time mesh and app alone can be ended"):
        run_virtually("consensus", "--robots", "3", "--kill", "r0.dwm@1s")


LINKS = (("r-0", "r1"), ("r1", "r-2-b"))


def cut_of(text: str, links: tuple[tuple[str, str], ...] = LINKS, seed: int = 1) -> Cut:
    names = sorted({name for link in links for name in link})
    (found,) = drawn([parsed_cut(f"{text}@2s,3s")], names, seed, links)
    return found


def test_the_links_tell_where_a_name_with_a_hyphen_ends_in_a_cut() -> None:
    assert cut_of("r-0-r1") == Cut("r-0", "r1", 2.0, 3.0)
    assert cut_of("r-2-b-r1") == Cut("r-2-b", "r1", 2.0, 3.0)
    with pytest.raises(ConfigError, match="--cut a-b-c@2s,3s: this names several links: a and b-c, a-b and c"):
        cut_of("a-b-c", (("a", "b-c"), ("c", "a-b")))


def test_the_seed_draws_the_link_of_a_cut_with_any() -> None:
    ends = {frozenset(pair) for pair in LINKS}
    assert {frozenset((each.a, each.b)) for seed in range(20) for each in [cut_of("any-any", seed=seed)]} == ends
    assert cut_of("any-r-0") == Cut("r1", "r-0", 2.0, 3.0)
    assert cut_of("any-r-2-b") == Cut("r1", "r-2-b", 2.0, 3.0)
    assert {cut_of("r1-any", seed=seed).b for seed in range(20)} == {"r-0", "r-2-b"}


@pytest.mark.parametrize("link", ["r0-r9", "r8-r9", "r1-r1", "any-r9"])
@pytest.mark.parametrize("topology", ["line", "auto"])
def test_a_cut_of_no_link_is_refused_on_every_topology(link: str, topology: str) -> None:
    with pytest.raises(ConfigError, match=f"--cut {link}@1s,1s: there is no such link .* robots are r0, r1, r2"):
        run_virtually(
            "consensus", "--robots", "3", "--topology", topology, "--cut", f"{link}@1s,1s", "--iterations", "1"
        )
