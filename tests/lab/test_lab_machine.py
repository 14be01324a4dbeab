"""The lab's machine itself: it boots both ways, does what it is told, and its disk outlives a power cut."""

import subprocess
import time
from collections.abc import Callable

import pytest

from lab.vm.machine import PLAIN, Machine, MachineError

pytest_plugins = ("lab_fixtures",)
pytestmark = [pytest.mark.lab, pytest.mark.timeout(400)]

LARGE = 1_000_000
"""Bytes that go to a machine in one piece."""


def test_a_machine_runs_commands_and_keeps_its_disk_through_a_power_cut(machine: Callable[..., Machine]) -> None:
    robot = machine("r0", init=PLAIN)
    robot.start()
    assert abs(int(robot.run("date +%s")) - time.time()) < 60
    assert robot.run("cat /proc/sys/kernel/osrelease") >= "6.12"
    assert robot.run("hostname") == "r0\n"
    (robot.share / "word").write_text("from the host")
    assert robot.run("cat /share/word; echo kept >/root/kept; sync") == "from the host"
    with pytest.raises(MachineError, match="exit code 3: no"):
        robot.run("echo no; exit 3")
    slow = robot.spawn("sleep 60", 1.0)
    assert robot.run("echo meanwhile") == "meanwhile\n"
    assert robot.wait(slow, 30, "the slow command is ended").code == 124
    robot.kill()
    cut = time.monotonic()
    with pytest.raises(MachineError, match="switched off"):
        robot.run("true")
    robot.start()
    assert robot.run("cat /root/kept; hostname") == "kept\nr0\n"
    assert float(robot.run("cut -d' ' -f1 /proc/uptime")) < time.monotonic() - cut, "it has not booted"
    robot.stop()


def test_a_serial_line_still_carries_after_more_has_come_than_the_kernel_holds(machine: Callable[..., Machine]) -> None:
    """Commands and the Bluetooth controller come over such lines; lab/vm/serial.patch says what was wrong with them."""
    robot = machine("r0", init=PLAIN)
    robot.start()
    text = "x" * 50_000
    assert robot.run(f"echo {text}") == text + "\n"
    assert robot.run("echo more", 10) == "more\n"


def test_a_whole_system_has_the_release_and_ssh(machine: Callable[..., Machine]) -> None:
    robot = machine("r0")
    robot.start()
    robot.run("systemctl start ssh")  # the agent is up before it is
    assert robot.ssh("/opt/swarm/current/bin/swarm --version").startswith("swarm ")
    sent = subprocess.run(
        [*robot.ssh_words(), "wc -c"], input=b"x" * LARGE, capture_output=True, check=True, timeout=200
    )
    assert int(sent.stdout) == LARGE
    assert robot.run("dmesg | grep -c GSO", code=1) == "0\n", "frames that the machine has thrown away"
    assert robot.run("systemctl is-enabled swarm-mesh", code=None) == "disabled\n"
    assert (
        robot.run("/opt/swarm/current/bin/python -c 'import bluetooth, socket; print(socket.AF_BLUETOOTH)'") == "31\n"
    )
