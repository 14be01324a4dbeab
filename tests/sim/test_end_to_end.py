"""Whole simulated swarms, started and treated as a user would."""

import contextlib
import os
import signal
import subprocess
import sys
from functools import cache
from pathlib import Path

import fork_server
import pytest
from conftest import wait_until

from bench.rigs import talking_sim
from bench.rigs.simulation import Simulation, SimulationError, simulate
from sim.virtual.run import run_virtually
from swarm.bus.zenoh_bus import Bus
from swarm.messages import read
from swarm.process.simulations import pid_of

FORKED = {"program": ("laptop.cli.runs.sim",), "start": fork_server.start}
"""A simulation whose processes need not start as a user's do, which takes much longer."""
RUN = ("consensus", "--iterations", "120", "--latency", "10ms")


def processes_of(run_dir: Path) -> list[int]:
    """Pids of all processes whose environment names the run directory."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            with contextlib.suppress(OSError):
                if os.fsencode(run_dir) in (entry / "environ").read_bytes():
                    found.append(int(entry.name))
    return found


@cache
def undisturbed():
    """The same run without disturbance, under virtual time: trajectories that others are compared with."""
    report, outcome = run_virtually(*RUN, rows=True)
    assert report["virtual"]
    assert report["messages_per_iteration"] == pytest.approx(4, abs=0.5)
    return outcome.trajectories


@pytest.mark.slow
def test_a_run_through_a_cut_link_is_the_undisturbed_one_bit_for_bit():
    """Consensus ends on the mean and reports it; the cut holds the swarm up, and loses nothing."""
    with Simulation(*RUN, "--cut", "r0-r1@0.3s,1s", **FORKED) as simulation:
        report = simulation.finish()
        assert report["app"] == "consensus"
        assert report["algorithm"] == "metropolis"
        assert report["iterations"] == 120
        assert report["error"] < 1e-9
        assert report["problems"] == []
        assert report["restarts"] == 0
        assert report["messages_per_iteration"] > 3.5  # 2E, and those that are asked for again where a machine is busy
        assert report["iteration_s_median"] > 0.010
        assert report["rss_mib_per_robot"] > 20
        for name, path in undisturbed().items():
            found = simulation.trajectory(name)
            assert found.columns == path.columns
            assert found.rows == path.rows
            assert max(at - found.times[k - 1] for k, at in found.times.items() if k) > 0.8
        assert found.last == 120
        assert simulation.trajectory("r0").value(0, "value") == 0.5


@pytest.mark.slow
def test_a_run_over_a_hub_whose_mesh_ends_is_the_undisturbed_one_bit_for_bit():
    """The robots are a line; the first one carries what the other two tell each other, and starts anew meanwhile."""
    with Simulation(*RUN, "--links", "star", "--kill", "r0.mesh@0.5s", **FORKED) as simulation:
        report = simulation.finish()
        assert report["problems"] == []
        assert report["restarts"] == 1
        for name, path in undisturbed().items():
            assert simulation.trajectory(name).rows == path.rows


@pytest.mark.slow
def test_killed_services_and_a_stopped_app_change_no_bit():
    """Who is stopped is named by those who wait for it. Lockstep needs its apps and meshes alone, so the others are
    killed while it stands, for the run not to end before they are back."""
    with Simulation(*RUN) as simulation:
        simulation.wait_for("r1", 5)
        simulation.kill("r1", "app", "STOP")
        wait_until(lambda: "waits for r1" in simulation.said(), what="r1 is named by those who wait for it")
        killed = {}
        for victim in (("r0", "bus"), ("r0", "dwm"), ("r1", "balancer")):
            killed[victim] = pid_of(simulation.run_dir, *victim)
            simulation.kill(*victim)
        wait_until(
            lambda: all(pid_of(simulation.run_dir, *each) not in (None, pid) for each, pid in killed.items()),
            what="they are started again",
        )
        simulation.kill("r1", "app", "CONT")
        for at, (robot, service) in ((20, ("r1", "mesh")), (30, ("r2", "app/consensus"))):
            simulation.wait_for(robot, at)
            # Without the command: the run could be over before that has started.
            os.kill(pid_of(simulation.run_dir, robot, service), signal.SIGKILL)
        report = simulation.finish()
        assert report["restarts"] == 5
        for name, path in undisturbed().items():
            assert simulation.trajectory(name).rows == path.rows


def test_robots_that_only_talk_have_the_same_trajectory_and_three_processes_each():
    """What the benchmarks of lockstep run."""
    with Simulation(*RUN, program=talking_sim.PROGRAM, start=fork_server.start) as simulation:
        simulation.wait_for("r0", 5)
        started = {path.name for path in (simulation.run_dir / "r0").glob("*.log")}
        assert started == {"bus.log", "mesh.log", "app.consensus.log"}
        simulation.finish()
        for name, path in undisturbed().items():
            assert simulation.trajectory(name).rows == path.rows


@pytest.mark.slow
@pytest.mark.parametrize("service", ["bus", "mesh", "dwm", "balancer", "app"])
def test_one_killed_service_changes_no_bit(service):
    with Simulation("consensus", "--iterations", "120", "--latency", "50ms") as simulation:
        simulation.wait_for("r1", 20)
        simulation.kill("r1", service)
        assert simulation.finish()["restarts"] == 1
        for name, path in undisturbed().items():
            assert simulation.trajectory(name).rows == path.rows


def test_a_second_simulation_is_refused_nothing_survives_a_killed_one_and_the_next_ends_by_ctrl_c_with_a_report():
    words = ("consensus", "--robots", "2", "--seconds", "600", "--latency", "10ms")
    with Simulation(*words) as first:
        first.wait_for("r0", 1)
        command = [sys.executable, "-m", "laptop.cli", "sim", *words, "--run-dir", str(first.run_dir)]
        second = subprocess.run(command, capture_output=True, text=True, check=False)
        assert second.returncode == 2
        assert "already running" in second.stderr
        assert "--run-dir" in second.stderr
        first.wait_for("r0", first.trajectory("r0").last + 5)  # it did not notice
        assert len(processes_of(first.run_dir)) > 8
        first.process.send_signal(signal.SIGKILL)
        wait_until(lambda: not processes_of(first.run_dir), what="all children are gone")
        # What the killed run left (sockets, locks, snapshots) does not hinder the next.
        with Simulation(*words, run_dir=first.run_dir) as again:
            again.wait_for("r0", 10)
            again.process.send_signal(signal.SIGINT)
            assert again.finish()["iterations"] >= 9
            assert again.process.returncode == 128 + signal.SIGINT
        assert not processes_of(first.run_dir)


def test_a_broken_app_file_is_named(tmp_path):
    app = tmp_path / "broken.py"
    app.write_text("import nonsense_that_is_not_there\n")
    with pytest.raises(SimulationError, match="nonsense_that_is_not_there") as failure:
        simulate(str(app), "--iterations", "5")
    assert "Traceback" not in str(failure.value)


@pytest.mark.parametrize("iteration", [0, pytest.param(7, marks=pytest.mark.slow)])
def test_an_app_that_raises_is_named_with_robot_and_iteration(iteration, tmp_path):
    app = tmp_path / "crashing.py"
    app.write_text(
        "from swarm import SyncApp\n"
        "class Crashing(SyncApp):\n"
        "    value: float = 0.0\n"
        "    def step(self, neighbours):\n"
        f"        self.value = 1 / ({iteration} - self.k)\n"
    )
    with pytest.raises(SimulationError, match=rf"iteration {iteration}") as failure:
        simulate(str(app), "--robots", "2", "--iterations", "20", **FORKED)
    assert "no first iteration" not in str(failure.value)


@pytest.mark.slow
def test_a_robot_with_another_version_of_the_app_is_named(tmp_path):
    """It is changed in mid-run, and one robot's process starts again: the others take nothing of it."""
    app = tmp_path / "mean.py"
    app.write_text((Path(__file__).parents[2] / "examples" / "consensus.py").read_text())
    with Simulation(str(app), "--seconds", "600", "--set", "value=1", "--latency", "10ms") as simulation:
        simulation.wait_for("r1", 20, "mean")
        app.write_text(app.read_text() + "\n")
        with Bus.of(simulation.run_dir / "r0") as bus:
            told = []
            bus.subscribe("swarm/r0/app/mean/progress", lambda key, data: told.append(read(key, data).reason))
            simulation.kill("r1", "app")
            wait_until(lambda: "r1 runs another version of this app" in told, what="the version is named")
        simulation.process.send_signal(signal.SIGINT)
        said = r"r0 app waits for r1 at iteration \d+: r1 runs another version of this app"
        with pytest.raises(SimulationError, match=said):
            simulation.finish()
        assert simulation.trajectory("r0", "mean").last > 20


@pytest.mark.slow
def test_a_robot_that_is_cut_off_for_ever_does_not_keep_the_others_from_their_end():
    drop = ("--absent", "drop", "--drop-after", "1.5", "--cut", "r1-r2@0.2s,999s")
    report = simulate("consensus", "--iterations", "60", "--latency", "10ms", *drop, **FORKED)
    assert report["missing"] == ["r2"]
    assert report["iterations"] == 60
    assert report["problems"] == []
    assert report["result"]["r0"] == pytest.approx(report["result"]["r1"])


@pytest.mark.slow
def test_robots_without_an_app_just_balance():
    report = simulate("--robots", "2", "--seconds", "2")
    assert report["app"] is None
    # How upright they stand is tested under virtual time; here the host may be too busy for a loop of 100 Hz.
    assert {body["mode"] for body in report["result"].values()} == {"balancing"}


def test_a_swarm_of_one_robot_runs():
    report = simulate("consensus", "--robots", "1", "--iterations", "20", "--set", "value=2", **FORKED)
    assert report["result"] == {"r0": {"value": 2.0}}


@pytest.mark.slow
def test_localization_finds_the_target():
    report = simulate("localization", "--iterations", "60")
    assert report["error_cm"] < 15


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_six_balancing_robots_cross_without_contact():
    """Each to the opposite side, as the app has it where no waypoints are given. The run ends when all have arrived.

    The balancer, the body that falls if it is late, odometry, UWB, EKF and mesh of each robot: 36 processes.
    (`./run bench teamwork` does so with a formation.)
    """
    report = simulate("goto", "--robots", "6", "--topology", "line", "--jitter", "10ms")
    assert report["problems"] == []
    assert report["scene"]["closest_m"] > 0.15
    assert all(result["reached"] == result["of"] for result in report["result"].values())
