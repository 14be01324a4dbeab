"""Three robots, each a machine with its own kernel, systemd, I2C bus and radio: put into operation from the host as
from a laptop, they find the target; one loses its power in the middle of it, boots again and joins again."""

import json
import math
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from lab import waiting
from lab.radio.remote import Radio, address
from lab.robot import disk
from lab.vm.build import Image
from lab.vm.machine import Machine
from lab.waiting import PATIENCE_S, Wait
from swarm.config.keyfile import new_key_file

pytest_plugins = ("lab_fixtures",)
pytestmark = [pytest.mark.lab, pytest.mark.timeout(1400)]

NAMES = ("r0", "r1", "r2")
TARGET = (1.3, 0.8)
"""With it a module has four in reach, as many as it ranges to."""
PLACES = {"r0": (0.4, 0.5), "r1": (1.7, 0.4), "r2": (1.1, 1.7)}
DROP_AFTER_S = 15.0
"""Longer than a robot may be silent because its host is busy. If r0 was dropped as well, r1 alone would be no majority,
and the power cut of r2 would end the run."""
SEEDS = 12
"""Simulations that tell how far off such a swarm is: errors of modules are drawn."""

CONFIG = f"""network = "lab"
[topology]
shape = "full"
[mesh]
links = "graph"
[dwm]
source = "serial:/run/lab/{{robot}}/dwm.tty"
target = "C933"
[[anchors]]
address = "D001"
x = 0.0
y = 0.0
[[anchors]]
address = "D002"
x = 2.0
y = 0.0
[[anchors]]
address = "D003"
x = 0.0
y = 2.0
[simulation]
target = [{TARGET[0]}, {TARGET[1]}]
[simulation.places]
"""


def config() -> str:
    places = "".join(f"{name} = [{x}, {y}, 0.0]\n" for name, (x, y) in PLACES.items())
    robots = "".join(
        f'[[robots]]\nname = "{name}"\nlink = "rfcomm:{address(number)}"\n' for number, name in enumerate(NAMES)
    )
    return CONFIG + places + robots


class Laptop:
    """The commands of a researcher, with a folder for what they need."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.config = folder / "swarm.toml"
        self.config.write_text(config())
        self._ssh = folder / "ssh_config"

    def knows(self, machines: list[Machine]) -> None:
        """How robots are reached: another address after each boot."""
        lines = []
        for machine in machines:
            words = machine.ssh_words()
            options = "".join(f"  {words[at + 1].replace('=', ' ')}\n" for at, word in enumerate(words) if word == "-o")
            identity = f"  IdentityFile {machine.folder / 'ssh_key'}\n"
            lines.append(f"Host {machine.name}\n  HostName {machine.address}\n  User root\n{identity}{options}")
        self._ssh.write_text("".join(lines))

    def words(self, command: str) -> list[str]:
        program, *rest = command.split()
        module = {"swarm": "laptop.cli", "z_sub": "laptop.cli.z_sub"}[program]
        own = ["--config", str(self.config), "--ssh-config", str(self._ssh)]
        return [sys.executable, "-m", module, *rest, *own]

    def do(self, command: str) -> str:
        """Run the command and return its output; it must succeed."""
        return waiting.run(command, self.words(command), PATIENCE_S + 10)

    @contextmanager
    def watch(self, robot: str, app: str) -> Iterator[Callable[[str, str, Callable[[Any], object]], Any]]:
        """Watch what an app says by `z_sub --robots`. What this gives waits for a payload of a topic for which the
        condition is true. It hears nothing that was said before it was connected, which may take many seconds."""
        keys = f"swarm/{robot}/app/{app}"
        process = subprocess.Popen(
            self.words(f"z_sub {keys}/* --robots {robot} --json"),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        lines: queue.Queue[str] = queue.Queue()
        assert process.stdout is not None
        reader = threading.Thread(target=lambda out: [lines.put(line) for line in out], args=(process.stdout,))
        reader.start()
        last: Any = None

        def until(what: str, topic: str, condition: Callable[[Any], object]) -> Any:
            nonlocal last
            wait = Wait(f"{keys}/{topic} of {robot}: {what}", state=lambda: last)
            while True:
                with suppress(queue.Empty):
                    last = json.loads(lines.get(timeout=wait.look()))
                    if last["key"] == f"{keys}/{topic}" and condition(last["value"]):
                        return last["value"]

        try:
            yield until
        finally:
            process.terminate()
            process.wait(20)
            reader.join()
            process.stdout.close()


def simulated_error(laptop: Laptop) -> float:
    """How far off the same swarm is in simulation, m: the worst of some seeds."""

    def once(seed: int) -> float:
        words = f"sim localization --virtual --iterations 200 --json --seed {seed} --config {laptop.config}".split()
        said = waiting.run(f"the simulation of seed {seed}", [sys.executable, "-m", "laptop.cli", *words])
        return float(json.loads(said.splitlines()[-1])["error_cm"]) / 100

    with ThreadPoolExecutor(2) as pool:
        return max(pool.map(once, range(1, SEEDS + 1)))


def boot(machine: Machine) -> None:
    """Until it is a robot that can be reached."""
    machine.start()
    machine.run("systemctl start swarm.target ssh", PATIENCE_S)


def off(state: Any) -> float:
    return math.dist((state["result"]["x"], state["result"]["y"]), TARGET)


def test_three_machines_find_the_target_and_one_comes_back_from_a_power_cut(
    lab_image: Image, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    laptop = Laptop(tmp_path)
    new_key_file(tmp_path / "swarm.key", int(time.time()))
    simulated = simulated_error(laptop)
    image = disk.robots(lab_image, tmp_path, config(), tmp_path / "swarm.key")
    with Radio(tmp_path, len(NAMES), machines=True) as radio, ThreadPoolExecutor() as pool:
        machines = [
            Machine(image, tmp_path / name, name, radio=tmp_path / f"radio-{number}", niceness=disk.NICENESS)
            for number, name in enumerate(NAMES)
        ]
        assert radio.addresses == [address(number) for number in range(len(NAMES))]
        try:
            began = time.monotonic()
            list(pool.map(boot, machines))
            laptop.knows(machines)
            booted = time.monotonic() - began
            laptop.do(f"swarm run localization --absent drop --drop-after {DROP_AFTER_S} --timeout {PATIENCE_S:.0f}")
            with laptop.watch("r0", "localization") as until:
                found = until("the target is found", "state", lambda state: state["k"] > 50 and off(state) <= simulated)
            cold_start = float(machines[0].run("cat /proc/uptime").split()[0])
            rejoined = power_cut(laptop, machines)
            laptop.do(f"swarm services stop localization --timeout {PATIENCE_S:.0f}")
            laptop.do(f"swarm fetch --into {tmp_path / 'runs'}")
        finally:
            for machine in machines:
                machine.kill()
    record_property(
        "measured",
        f"booted {booted:.0f} s, target after {cold_start:.0f} s, {100 * off(found):.1f} cm off (simulated: up to "
        f"{100 * simulated:.1f}), booted and joined again {rejoined:.0f} s",
    )
    assert {path.name.split(".")[0] for path in (tmp_path / "runs").glob("localization-*/*.mcap")} == set(NAMES)


def power_cut(laptop: Laptop, machines: list[Machine]) -> float:
    """r2 goes off and on again; s from its power until it is a member again."""
    with laptop.watch("r0", "localization") as until:
        until("the watch is connected", "state", lambda state: True)
        machines[2].kill()
        without = until("the members are r0 and r1", "epoch", lambda epoch: epoch["members"] == ["r0", "r1"])
        began = time.monotonic()
        boot(machines[2])
        laptop.knows(machines)
        laptop.do(f"swarm services start localization --robots r2 --timeout {PATIENCE_S:.0f}")
        again = until("the members are all three", "epoch", lambda epoch: epoch["members"] == list(NAMES))
    assert again["epoch"] > without["epoch"]
    with laptop.watch("r2", "localization") as until:
        until("r2 finds the target again", "state", lambda state: state["k"] > again["k"] + 20 and off(state) < 0.3)
    return time.monotonic() - began
