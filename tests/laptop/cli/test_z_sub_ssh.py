"""`z_sub --robots NAME` through real ssh servers, to real buses; nothing stays behind on a robot."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import fork_server
import pytest
from conftest import wait_until
from fake_robots import FakeRobots
from needs import needs_ssh

from laptop.fleet.ssh.ssh import last_words
from swarm.bus.zenoh_bus import Bus, Router
from swarm.messages import Leds
from swarm.process.paths import bus_endpoint

pytest_plugins = ["fleet_fixtures"]
pytestmark = needs_ssh

RED = Leds(1.0, red=True, yellow=False, green=False)
FAR = """shift; shift; echo $$ >> $HOME/started
SWARM_RUNTIME=$HOME exec {python} -m swarm.onboard.z_sub "$@"
"""


@pytest.fixture
def add(robots: FakeRobots) -> Iterator[Callable[[str], Path]]:
    """A robot with a bus, on which its LEDs are told all the time."""
    opened: list[Router | Bus] = []

    def one(name: str) -> Path:
        hook = f"export PYTHONPATH={os.environ.get('PYTHONPATH', os.getcwd())}"  # noqa: PTH109
        home = robots.add(name, hook=hook)
        robots.script(name, "sudo", FAR.format(python=sys.executable))
        opened.append(Router(bus_endpoint(home)))
        return home

    yield one
    for each in opened:
        each.close()


def start(robots: FakeRobots, *arguments: str) -> subprocess.Popen[str]:
    robots.ready()
    command = [sys.executable, "-m", "laptop.cli.z_sub", *arguments]
    command += ["--config", str(robots.config), "--ssh-config", str(robots.ssh_config)]
    return fork_server.start(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process: subprocess.Popen[str], *homes: Path) -> tuple[int, str, str]:
    """Publish on the robots' buses until it ends."""
    buses = [Bus.of(home) for home in homes]
    try:
        while process.poll() is None:
            for home, bus in zip(homes, buses, strict=True):
                bus.publish(f"swarm/{home.name}/balancer/leds", RED)
            time.sleep(0.05)
    finally:
        for bus in buses:
            bus.close()
    output, errors = process.communicate()
    return process.returncode, output, errors


def gone(home: Path) -> bool:
    """Whether all z_sub processes of a robot have ended."""
    for pid in (home / "started").read_text().split():
        with contextlib.suppress(FileNotFoundError):
            # The number of one that has ended may be that of another process by now, which works elsewhere.
            if Path(f"/proc/{pid}/cwd").readlink() == home:
                return False
    return True


def test_z_sub_shows_the_samples_of_one_robot_over_ssh(robots: FakeRobots, add: Callable[[str], Path]) -> None:
    home = add("r0")
    process = start(robots, "--robots", "r0", "swarm/*/balancer/**", "--count", "2")
    code, output, errors = finish(process, home)
    assert (code, errors) == (0, "")
    assert [line.split()[1] for line in output.splitlines()] == ["swarm/r0/balancer/leds"] * 2


def test_several_robots_one_of_them_away(robots: FakeRobots, add: Callable[[str], Path]) -> None:
    homes = [add("r0"), add("r1")]
    robots.add("r2", up=False)
    process = start(robots, "--robots", "r0", "--robots", "r1", "--robots", "r2", "--json", "--count", "3")
    code, output, errors = finish(process, *homes)
    assert (code, errors) == (2, "z_sub: r2: it runs no ssh server (or another port)\n")
    lines = [json.loads(line) for line in output.splitlines()]
    assert sorted(line["robot"] for line in lines) == ["r0"] * 3 + ["r1"] * 3
    process = start(robots, "--robots", "r0", "--robots", "r1", "--count", "1")
    _, output, _ = finish(process, *homes)
    assert sorted(line[:5] for line in output.splitlines()) == ["[r0] ", "[r1] "]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_z_sub_over_ssh_leaves_no_process_on_a_robot(
    robots: FakeRobots, add: Callable[[str], Path], number: signal.Signals
) -> None:
    """Ctrl-C, or a laptop that dies, while there is nothing to be told."""
    home = add("r0")
    process = start(robots, "--robots", "r0")
    bus = Bus.of(home)
    assert process.stdout is not None
    wait_until((home / "started").exists)
    bus.publish("swarm/r0/balancer/leds", RED)
    bus.close()
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert errors == ""
    wait_until(lambda: gone(home), what="its z_sub has ended")


def test_a_bus_that_is_not_there_is_told(robots: FakeRobots) -> None:
    home = robots.add("r0", hook=f"export PYTHONPATH={os.environ.get('PYTHONPATH', os.getcwd())}")  # noqa: PTH109
    robots.script("r0", "sudo", FAR.format(python=sys.executable))
    process = start(robots, "--robots", "r0")
    assert process.stderr is not None
    assert process.stderr.readline() == f"z_sub: r0: unixsock-stream/{home}/bus.sock is not there, waiting for it\n"
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, output, errors) == (0, "", "")


def test_what_is_wrong_is_said(robots: FakeRobots) -> None:
    robots.add("r0", known=False)
    code, output, errors = finish(start(robots, "--robots", "r0"))
    assert (code, output) == (2, "")
    assert errors.startswith("z_sub: r0: its host key has changed; if set up anew: ssh-keygen -")
    code, _, errors = finish(start(robots, "--robots", "r7"))
    assert (code, errors) == (2, f"z_sub: r7 is no robot of {robots.config}; there are r0\n")
    robots.add("r1")
    robots.script("r1", "sudo", "echo 'sudo: a password is required' >&2; exit 1")
    code, _, errors = finish(start(robots, "--robots", "r1"))
    assert (code, errors) == (2, f"z_sub: r1: {last_words('sudo: a password is required')}\n")
