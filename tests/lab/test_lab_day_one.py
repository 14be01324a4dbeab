"""The documented path on three robots, each a machine of its own: the very code blocks of the tutorial with the labels
`laptop` and `lab` (tests/docs/executed/documented_path.py), from an empty folder and provisioned machines to robots
that stand, and on to a run that was brought home."""

import os
import re
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import documented_path
import pytest

from lab.radio.remote import Radio
from lab.robot import disk
from lab.vm.build import Image
from lab.vm.machine import Machine
from lab.waiting import PATIENCE_S, Wait, finished

pytest_plugins = ("lab_fixtures",)
pytestmark = [pytest.mark.lab, pytest.mark.timeout(1400)]

NAMES = ("r0", "r1", "r2")
STANDING_S = 600.0
"""From power on to robots that stand, by the documented commands, at most."""
APP = "tutorials/own-algorithm.md"
"""Where the tutorial's app stands."""
OF_THE_TUTORIAL = 'source = "balancer"'
OF_THE_LAB = 'source = "serial:/run/lab/{robot}/dwm.tty"'
"""Where the modules are: these robots have them at a port."""
PLACES = """
[simulation.places]
r0 = [0.4, 0.5, 0.0]
r1 = [1.7, 0.4, 0.0]
r2 = [1.1, 1.7, 0.0]
"""
"""What these robots have in place of places on a floor."""
POWERED = """
for i in $(seq 200); do timeout 10 bluetoothctl show | grep -q 'Powered: yes' && exit 0; sleep 0.3; done; exit 1
"""
LATE = re.compile(r"^\w+ +FAILED .*has no first state after", re.MULTILINE)
"""What `swarm run` says of a robot whose processes a busy host does not start within 20 s."""
SLOW = ("swarm run ", "swarm status")
"""Commands for which a robot needs minutes where two of them share a processor of the host, as three do on two."""
STAND = (documented_path.TUTORIAL, "swarm status --watch")
UNTIL = {STAND: re.compile("balancing")}
"""What each robot's row has before the person ends the table by Ctrl-C."""
DONE = re.compile(r"descent:done@500 ")
FAILED = re.compile(r"^(\w+) +FAILED ", re.MULTILINE)
FALLEN = re.compile(r"^(\w+) +FAILED .*this one is fault", re.MULTILINE)
"""What `swarm balance lie` says of a robot that has fallen. A simulated body falls where its loop, in a virtual
machine, does not get its 100 Hz from a busy host for long enough."""
FELL = "swarm balance stand"
"""What the column body of `swarm status` says to do with a robot that has fallen."""
MANY_FALLS = 6
NO_PI = {
    *("board", "system", "packages", "boot", "cmdline", "i2c", "radio", "bluetooth", "realtime", "network", "name"),
    "bus",
}
"""What the doctor finds wrong of machines that are no Pis, and that `swarm provision` has not made. `bus`: a
simulated I2C bus is as slow as its host, and the doctor may find that it has no time for all devices."""
WRONG = re.compile(r"^  (\w+) +WRONG", re.MULTILINE)


class Laptop:
    """A folder on a computer whose ssh reaches the robots by their names."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "home"
        self.falls = 0
        self._tools = folder / "tools"
        self._ssh = folder / "ssh_config"
        self.folder.mkdir()
        self._tools.mkdir()
        python = f"exec {sys.executable} -P -m laptop.cli"
        for name, line in (("swarm", f'{python} "$@"'), ("ssh", f'exec /usr/bin/ssh -F {self._ssh} "$@"')):
            path = self._tools / name
            path.write_text(f"#!/bin/sh\n{line}\n")
            path.chmod(path.stat().st_mode | stat.S_IXUSR)
        own = {name: value for name, value in os.environ.items() if not name.startswith("SWARM_")}
        self._environment = own | {
            "PATH": f"{self._tools}:{os.environ['PATH']}",
            "PYTHONPATH": str(documented_path.ROOT),
            "XDG_RUNTIME_DIR": str(folder / "none"),
            "MPLBACKEND": "Agg",
            "BROWSER": "/bin/true",
        }

    def knows(self, machines: list[Machine]) -> None:
        """How robots are reached."""
        lines = []
        for machine in machines:
            words = machine.ssh_words()
            options = "".join(f"  {words[at + 1].replace('=', ' ')}\n" for at, word in enumerate(words) if word == "-o")
            identity = f"  IdentityFile {machine.folder / 'ssh_key'}\n"
            lines.append(f"Host {machine.name}\n  HostName {machine.address}\n  User root\n{identity}{options}")
        self._ssh.write_text("".join(lines))

    def type(self, page: str, command: str) -> str:
        """Type one command; what it printed."""
        if (number := re.search(r"(\w+)-NUMBER", command)) is not None:
            run = max((self.folder / "runs").glob(f"{number[1]}-*"))
            command = command.replace(number[0], run.name)
        if (page, command) in UNTIL:
            return self._watch(command, UNTIL[page, command])
        if command.startswith("swarm view"):
            return self._watch(command, None)
        if command == "swarm doctor":
            return self._again(command, lambda text: not set(WRONG.findall(text)) - NO_PI)
        if command == "swarm status":
            return self._again(command, lambda text: len(DONE.findall(text)) == len(NAMES))
        code, text = self._finish(command)
        if command.startswith("swarm run ") and 0 < len(LATE.findall(text)) == text.count(" FAILED "):
            return text  # the app goes on, and `swarm status` is typed until it has ended
        if (
            command == "swarm balance lie"
            and (fallen := FALLEN.findall(text))
            and len(fallen) == text.count(" FAILED ")
        ):
            self.falls += len(fallen)
            command = f"swarm balance rest --robots {','.join(fallen)}"
            code, text = self._finish(command)
        if command == "swarm balance stand" and code == 1 and (fallen := FAILED.findall(text)):
            text = self._stand(fallen)
        else:
            assert code == 0, f"{page}: {command}: exit code {code}\n{text}"
        return text

    def _stand(self, fallen: list[str]) -> str:
        """Type it again for robots that have fallen, as the table tells a person to; what it printed last."""
        for _ in range(3):
            self.falls += len(fallen)
            code, text = self._finish(f"swarm balance stand --robots {','.join(fallen)}")
            if code == 0:
                return text
            fallen = FAILED.findall(text)
        pytest.fail(f"they do not stand: {text}")

    def _again(self, command: str, is_good: Callable[[str], bool]) -> str:
        """Type a command until what it prints is good, as a person does who waits for links or for the end of a run."""
        text = ""
        wait = Wait(f"{command}: all is well", PATIENCE_S, state=lambda: text)
        while not is_good(text) or not text:
            wait.look()
            _, text = self._finish(command)
        return text

    def _finish(self, command: str) -> tuple[int | None, str]:
        """Its exit code, and what it printed."""
        if command.startswith(SLOW):
            command += f" --timeout {PATIENCE_S - 30:.0f}"
        process = self._start(command)
        output, errors = finished(command, process, PATIENCE_S)
        return process.returncode, output + errors

    def _watch(self, command: str, pattern: re.Pattern[str] | None) -> str:
        """Look at what a command prints until each robot's row has the pattern, or until it has printed a line; then
        press Ctrl-C."""
        process = self._start(command)
        assert process.stdout is not None
        seen: dict[str, bool] = {}
        text = ""
        wait = Wait(f"{command}: {pattern and pattern.pattern}", PATIENCE_S, state=lambda: text[-600:])
        for line in process.stdout:
            text += line
            wait.look()
            name = line.partition(" ")[0]
            if name in NAMES and pattern is not None:
                seen[name] = pattern.search(line) is not None
                if not seen[name] and FELL in line and self.falls < MANY_FALLS:
                    self._stand([name])
            if (pattern is None and "http://" in line) or (len(seen) == len(NAMES) and all(seen.values())):
                break
        process.send_signal(2)
        output, errors = finished(f"{command} ends by Ctrl-C", process)
        assert process.returncode in (0, 130), f"{command}: exit code {process.returncode}\n{text}{output}{errors}"
        return text

    def _start(self, command: str) -> "subprocess.Popen[str]":
        return subprocess.Popen(
            ["/bin/sh", "-c", f"exec {command}"], cwd=self.folder, env=self._environment, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip


def boot(machine: Machine) -> None:
    """Until it is a Pi that can be reached, and whose Bluetooth works."""
    machine.wait_booted()
    machine.run("systemctl start ssh bluetooth", PATIENCE_S)
    machine.run(POWERED, PATIENCE_S)


@pytest.fixture(scope="module")
def laptop(tmp_path_factory: pytest.TempPathFactory) -> Laptop:
    """With the tutorial's two files."""
    made = Laptop(tmp_path_factory.mktemp("day"))
    for page, name in ((documented_path.TUTORIAL, "swarm.toml"), (APP, "descent.py")):
        (text,) = [each.text for each in documented_path.blocks(page) if each.label == name]
        (made.folder / name).write_text(text)
    file = made.folder / "swarm.toml"
    text = file.read_text()
    assert OF_THE_TUTORIAL in text
    file.write_text(text.replace(OF_THE_TUTORIAL, OF_THE_LAB) + PLACES)
    return made


@pytest.fixture(scope="module")
def machines(lab_image: Image, tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Machine]]:
    """Three that are provisioned and switched off."""
    folder = tmp_path_factory.mktemp("machines")
    image = disk.provisioned(lab_image, folder)
    with Radio(folder, len(NAMES), machines=True):
        made = [
            Machine(image, folder / name, name, radio=folder / f"radio-{number}", niceness=disk.NICENESS)
            for number, name in enumerate(NAMES)
        ]
        try:
            yield made
        finally:
            for machine in made:
                machine.kill()


def test_the_tutorial_leads_to_robots_that_stand_and_a_run_that_is_brought_home(
    laptop: Laptop, machines: list[Machine], record_property: Callable[[str, object], None]
) -> None:
    began = standing = 0.0
    took = []
    blocks = [each for each in documented_path.blocks(documented_path.TUTORIAL) if each.label in ("laptop", "lab")]
    for command in (command for block in blocks for command in block.commands):
        if command == "swarm pair":
            began = time.monotonic()
            for machine in machines:
                machine.switch_on()  # by this thread: a machine ends with the one that has switched it on
            with ThreadPoolExecutor() as pool:
                list(pool.map(boot, machines))
            laptop.knows(machines)
            took.append(f"boot {time.monotonic() - began:.0f} s")
        start = time.monotonic()
        laptop.type(documented_path.TUTORIAL, command)
        took.append(f"{command} {time.monotonic() - start:.0f} s")
        if (documented_path.TUTORIAL, command) == STAND:
            standing = time.monotonic() - began
    took.append(f"{laptop.falls} robots had fallen")
    record_property("measured", f"robots stand {standing / 60:.1f} min after power on; {', '.join(took)}")
    assert 0 < standing <= STANDING_S
    assert (laptop.folder / "descent.png").stat().st_size > 5000
