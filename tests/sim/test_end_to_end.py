"""Whole simulated swarms, started and treated as a user would."""

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import wait_until

from bench.simulation import Simulation, SimulationError, simulate
from services.sim.virtual.run import simulate as virtual


def processes_of(run_dir: Path) -> list[int]:
    """Pids of all processes whose environment names the run directory."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            with contextlib.suppress(OSError):
                if os.fsencode(run_dir) in (entry / "environ").read_bytes():
                    found.append(int(entry.name))
    return found


@pytest.fixture(scope="module")
def undisturbed():
    """One run that others are compared with: report and trajectories."""
    with Simulation("consensus", "--iterations", "120", "--latency", "10ms") as simulation:
        found = simulation.finish()
        return found, {name: simulation.trajectory(name) for name in ("r0", "r1", "r2")}


def test_consensus_ends_on_the_mean_and_reports_it(undisturbed):
    report, paths = undisturbed
    assert report["app"] == "consensus"
    assert report["algorithm"] == "metropolis"
    assert report["iterations"] == 120
    assert report["error"] < 1e-9
    assert report["problems"] == []
    assert report["restarts"] == 0
    assert report["messages_per_iteration"] > 3.5  # 2E, and those that are asked for again where a machine is busy
    assert report["iteration_s_median"] > 0.010
    assert report["rss_mib_per_robot"] > 20
    assert paths["r0"].value(0, "value") == 0.5


def test_virtual_time_gives_the_same_trajectory_bit_for_bit(undisturbed):
    _, expected = undisturbed
    report, outcome = virtual("consensus", "--iterations", "120", "--latency", "10ms", rows=True)
    assert report["virtual"]
    assert report["messages_per_iteration"] == pytest.approx(4, abs=0.5)
    for name, path in expected.items():
        assert outcome.trajectories[name].columns == path.columns
        assert outcome.trajectories[name].rows == path.rows


def test_killed_services_and_a_stopped_app_change_no_bit(undisturbed):
    """Who is stopped is named by those who wait for it."""
    _, expected = undisturbed
    with Simulation("consensus", "--iterations", "120", "--latency", "10ms") as simulation:
        simulation.wait_for("r1", 5)
        simulation.kill("r1", "app", "STOP")
        wait_until(lambda: "waits for r1" in simulation.said(), what="r1 is named by those who wait for it")
        simulation.kill("r1", "app", "CONT")
        victims = [("r1", "mesh"), ("r0", "bus"), ("r2", "app"), ("r0", "dwm"), ("r1", "balancer")]
        for at, (robot, service) in enumerate(victims, 1):
            simulation.wait_for(robot, 10 * at)
            simulation.kill(robot, service)
        report = simulation.finish()
        assert report["restarts"] == len(victims)
        for name, path in expected.items():
            assert simulation.trajectory(name).rows == path.rows


@pytest.mark.slow
@pytest.mark.parametrize("service", ["bus", "mesh", "dwm", "balancer", "app"])
def test_one_killed_service_changes_no_bit(undisturbed, service):
    _, expected = undisturbed
    # Links slow enough for the run to outlast the start of the command that kills.
    with Simulation("consensus", "--iterations", "120", "--latency", "50ms") as simulation:
        simulation.wait_for("r1", 20)
        simulation.kill("r1", service)
        assert simulation.finish()["restarts"] == 1
        for name, path in expected.items():
            assert simulation.trajectory(name).rows == path.rows


def test_nothing_survives_the_end_or_a_killed_parent():
    with Simulation("consensus", "--robots", "2", "--seconds", "60", "--latency", "10ms") as simulation:
        simulation.wait_for("r0", 5)
        assert len(processes_of(simulation.run_dir)) > 8
        simulation.process.send_signal(signal.SIGKILL)
        wait_until(lambda: not processes_of(simulation.run_dir), what="all children are gone")
        # What the killed run left (sockets, locks, snapshots) does not hinder the next.
        again = ["consensus", "--robots", "2", "--iterations", "20", "--run-dir", str(simulation.run_dir)]
        command = [sys.executable, "-m", "swarm.cli", "sim", *again]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert not processes_of(simulation.run_dir)


def test_a_second_simulation_at_the_same_place_is_refused_and_ctrl_c_ends_the_first_with_a_report():
    with Simulation("consensus", "--robots", "2", "--seconds", "60") as simulation:
        simulation.wait_for("r0", 1)
        command = [sys.executable, "-m", "swarm.cli", "sim", "--run-dir", str(simulation.run_dir)]
        second = subprocess.run(command, capture_output=True, text=True, check=False)
        assert second.returncode == 2
        assert "already running" in second.stderr
        assert "--run-dir" in second.stderr
        simulation.wait_for("r0", 10)  # the first one did not notice
        simulation.process.send_signal(signal.SIGINT)
        report = simulation.finish()
        assert report["iterations"] >= 9
        assert not processes_of(simulation.run_dir)


def test_a_broken_app_file_is_named(tmp_path):
    app = tmp_path / "broken.py"
    app.write_text("import nonsense_that_is_not_there\n")
    with pytest.raises(SimulationError, match="nonsense_that_is_not_there") as failure:
        simulate(str(app), "--iterations", "5")
    assert "Traceback" not in str(failure.value)


@pytest.mark.parametrize("iteration", [0, 7])
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
        simulate(str(app), "--robots", "2", "--iterations", "20")
    assert "no first iteration" not in str(failure.value)


@pytest.mark.slow
def test_a_robot_with_another_version_of_the_app_is_named(tmp_path):
    """It is changed in mid-run, and one robot's process starts again: the others take nothing of it."""
    app = tmp_path / "mean.py"
    app.write_text((Path(__file__).parents[2] / "examples" / "consensus.py").read_text())
    with Simulation(str(app), "--seconds", "12", "--set", "value=1", "--latency", "10ms") as simulation:
        simulation.wait_for("r1", 20, "mean")
        app.write_text(app.read_text() + "\n")
        simulation.kill("r1", "app")
        said = r"r0 app waits for r1 at iteration \d+: r1 runs another version of this app"
        with pytest.raises(SimulationError, match=said):
            simulation.finish()
        assert simulation.trajectory("r0", "mean").last > 20


def test_a_cut_link_holds_the_swarm_up_and_loses_nothing(undisturbed):
    _, expected = undisturbed
    with Simulation("consensus", "--iterations", "120", "--latency", "10ms", "--cut", "r0-r1@0.3s,1s") as simulation:
        report = simulation.finish()
        assert report["problems"] == []
        for name, path in expected.items():
            found = simulation.trajectory(name)
            assert found.rows == path.rows
            assert max(at - found.times[k - 1] for k, at in found.times.items() if k) > 0.8


def test_a_robot_that_is_cut_off_for_ever_does_not_keep_the_others_from_their_end():
    drop = ("--absent", "drop", "--drop-after", "1.5", "--cut", "r1-r2@0.2s,999s")
    report = simulate("consensus", "--iterations", "60", "--latency", "10ms", *drop)
    assert report["missing"] == ["r2"]
    assert report["iterations"] == 60
    assert report["problems"] == []
    assert report["result"]["r0"] == pytest.approx(report["result"]["r1"])


@pytest.mark.slow
def test_robots_without_an_app_just_balance():
    report = simulate("--robots", "2", "--seconds", "2")
    assert report["app"] is None
    for body in report["result"].values():
        assert body["mode"] == "balancing"
        assert abs(body["tilt_deg"]) < 15


def test_one_robot_alone_runs():
    report = simulate("consensus", "--robots", "1", "--iterations", "20", "--set", "value=2")
    assert report["result"] == {"r0": {"value": 2.0}}


@pytest.mark.slow
def test_localization_finds_the_target():
    report = simulate("localization", "--iterations", "60")
    assert report["error_cm"] < 15


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_six_balancing_robots_cross_without_contact():
    """Each to the opposite side, as the app has it where no waypoints are given.

    The balancer, the body that falls if it is late, odometry, UWB, EKF and mesh of each robot: 36 processes.
    (`./run bench teamwork` does so with a formation.)
    """
    report = simulate("goto", "--robots", "6", "--topology", "line", "--jitter", "10ms", "--seconds", "75")
    assert report["problems"] == []
    assert report["scene"]["closest_m"] > 0.15
    assert all(result["reached"] == result["of"] for result in report["result"].values())
