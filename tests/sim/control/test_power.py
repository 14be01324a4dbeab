"""A simulated robot that is switched off and on: what ends, what is lost, and what is kept."""

import argparse
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from laptop.cli import hand
from sim.control import power_switch
from sim.control.power_server import Power
from sim.processes.processes import Processes
from swarm.errors import LocalError
from swarm.process.simulations import claim, pid_file, pid_of


@pytest.fixture
def processes(tmp_path: Path) -> Iterator[Processes]:
    """Two robots with a process each that waits to be ended."""
    (tmp_path / "wait.py").write_text("import signal\nsignal.pause()\n")
    found = Processes({"PYTHONPATH": str(tmp_path)})
    for robot in ("r0", "r1"):
        (tmp_path / robot / power_switch.DISK).mkdir(parents=True)
        found.add(robot, "bus", ["wait"], tmp_path / robot)
    yield found
    found.stop()


@pytest.fixture
def switches(tmp_path: Path, processes: Processes) -> Iterator[Power]:
    found = Power(tmp_path, ("r0", "r1"), processes)
    yield found
    found.close()


def test_its_processes_end_and_its_memory_is_lost(tmp_path: Path, processes: Processes, switches: Power) -> None:
    home, other = tmp_path / "r0", tmp_path / "r1"
    for name in ("app.x.snapshot", "bus.sock"):
        (home / name).touch()
        (other / name).touch()
    (home / "folder").mkdir()
    (home / "dwm.tty").symlink_to("/dev/null")
    (home / power_switch.DISK / "vote").touch()
    old = processes.of("r0")[0].process
    power_switch.reboot(tmp_path, "r0", 2.0)
    switches.look(10.0)
    assert old is not None
    assert old.returncode == -9
    assert sorted(entry.name for entry in home.iterdir()) == ["bus.log", "disk", "dwm.tty"]
    assert (home / power_switch.DISK / "vote").exists()
    assert (other / "app.x.snapshot").exists()
    assert processes.of("r1")[0].process is not None
    # Not started again before its time is over, although it has ended.
    switches.look(11.9)
    assert processes.supervise(11.9) == []
    assert pid_of(tmp_path, "r0", "bus") is None
    switches.look(12.0)
    assert pid_of(tmp_path, "r0", "bus") not in (None, old.pid)


def test_a_robot_that_is_off_already_stays_off_for_the_longest_time(
    tmp_path: Path, processes: Processes, switches: Power
) -> None:
    switches.off("r0", 10.0, 5.0)
    switches.off("r0", 11.0, 1.0)
    switches.look(14.9)
    assert switches.is_off("r0")
    switches.look(15.0)
    assert not switches.is_off("r0")
    assert switches.cycles["r0"] == 1


def test_a_boot_forgets_that_a_service_was_given_up(tmp_path: Path, processes: Processes, switches: Power) -> None:
    child = processes.of("r0")[0]
    for now in range(5):
        assert child.process is not None
        child.process.kill()
        child.process.wait()
        processes.supervise(float(now))
        if not child.given_up:
            processes.supervise(now + 0.5)
    assert child.given_up == "ended 5 times within 10 s"
    power_switch.reboot(tmp_path, "r0", 0.0)
    switches.look(5.0)
    assert child.given_up == ""
    assert child.process is not None
    assert child.process.poll() is None


def test_the_state_directory_is_on_the_disk(tmp_path: Path, processes: Processes) -> None:
    assert processes.of("r0")[0].environment["SWARM_STATE"] == str(tmp_path / "r0" / "disk")


def test_what_is_no_wish_is_dropped(tmp_path: Path, processes: Processes, switches: Power) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.sendto(b"\x93nonsense", str(tmp_path / power_switch.SOCKET))
    power_switch.reboot(tmp_path, "r7", 0.0)
    switches.look(1.0)
    assert all(child.process is not None for child in processes.children)


def test_wrong_wishes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LocalError, match=r"the simulation in .* does not listen"):
        power_switch.reboot(tmp_path, "r0", 1.0)
    with pytest.raises(LocalError, match="off for 0 to 600 s, not -1"):
        power_switch.reboot(tmp_path, "r0", -1.0)


def test_the_command_asks_the_simulation_that_runs(
    tmp_path: Path, processes: Processes, switches: Power, capsys: pytest.CaptureFixture[str]
) -> None:
    parser = argparse.ArgumentParser()
    hand.add_arguments(parser)
    (tmp_path / "sim.lock").touch()
    (tmp_path / "swarm.toml").write_text('[[robots]]\nname = "r0"\n')
    with pytest.raises(LocalError, match="no simulation is running"):
        hand.run(parser.parse_args(["reboot", "r0", "--run-dir", str(tmp_path)]))
    with claim(tmp_path):
        with pytest.raises(LocalError, match="no robot 'r9'"):
            hand.run(parser.parse_args(["reboot", "r9", "--run-dir", str(tmp_path)]))
        assert hand.run(parser.parse_args(["reboot", "r0", "--off", "0.5", "--run-dir", str(tmp_path)])) == 0
    assert capsys.readouterr().out == "r0: off, and on again in 0.5 s\n"
    switches.look(1.0)
    assert not pid_file(tmp_path, "r0", "bus").exists()
