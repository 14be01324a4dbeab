"""One machine for each robot: each has a kernel, an adapter and a clock of its own; the air is on the host."""

import json
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from bench.faults import restless_rule
from lab import waiting
from lab.inside import command, furnish
from lab.radio.remote import Radio
from lab.shapes import ITERATIONS, LINE, ROBOTS, SHAPES, config, line
from lab.vm.build import Image
from lab.vm.machine import PLAIN, Machine
from lab.waiting import PATIENCE_S, until
from swarm.config.keyfile import new_key_file
from swarm.core.graph import Graph
from swarm.recording import trajectory
from swarm.recording.run import Run

pytest_plugins = ("lab_fixtures",)
pytestmark = [pytest.mark.lab, pytest.mark.timeout(900)]

KEY = 'key = "/share/swarm.key"'
DROP_AFTER_S = 10.0
"""Longer than a busy host keeps a machine from computing."""


class Swarm:
    """Machines that are robots r0, r1, ..., and what they say of the app that each runs."""

    def __init__(self, image: Image, folder: Path, count: int, radio: Radio) -> None:
        self.folder = folder
        self.radio = radio
        self.names = [f"r{i}" for i in range(count)]
        self.machines = {
            name: Machine(image, folder / name, name, init=PLAIN, radio=folder / f"radio-{number}")
            for number, name in enumerate(self.names)
        }
        self._commands: dict[str, int] = {}
        new_key_file(folder / "swarm.key", int(time.time()))

    def boot(self, *names: str) -> None:
        """All at once."""
        robots = [self.machines[name] for name in names]
        for robot in robots:
            robot.switch_on()
        with ThreadPoolExecutor() as pool:
            list(pool.map(self._furnish, robots))

    def _furnish(self, robot: Machine) -> None:
        robot.wait_booted()
        furnish(robot)
        shutil.copy(self.folder / "swarm.key", robot.share)

    def begin(self, texts: dict[str, str], words: str, *names: str) -> None:
        """The app and its options on these robots: a run with each swarm.toml, which is called as the shape is."""
        for name in names:
            robot = self.machines[name]
            for shape, text in texts.items():
                (robot.share / f"{shape}.toml").write_text(text)
                (robot.share / f"go-on-{shape}").touch()
            said = "/share/said"
            (robot.share / "said").write_text("")
            run = command(f"tests/lab/inside/inside_robot_mesh.py {name} {','.join(texts)} {words}")
            self._commands[name] = robot.spawn(f"({run}) >>{said} 2>&1; code=$?; echo ended >>{said}; exit $code")

    def until(self, name: str, shape: str, condition: Callable[[dict[str, Any]], object], what: str) -> dict[str, Any]:
        """What the robot has said in that run when that was so."""
        path = self.machines[name].share / "said"

        def found() -> dict[str, Any] | None:
            text = path.read_text()
            whole, _, _ = text.rpartition("\n")
            for said in (json.loads(one) for one in whole.splitlines() if one.startswith("{")):
                if said["config"] == shape and condition(said):
                    return dict(said)
            assert "ended" not in text.splitlines()[-1:], f"{name}, {shape}: it ended, not {what}: {text[-3000:]}"
            return None

        return until(f"{name}, {shape}: {what}", found, state=self._state, every=0.2)

    def links(self) -> set[tuple[int, int]]:
        """The numbers of the robots that have links, as the air has them."""
        numbers = {address: number for number, address in enumerate(self.radio.addresses)}
        return {(numbers[one], numbers[other]) for one, other in self.radio.order("look")["links"]}

    def wait_links(self, pairs: list[tuple[int, int]]) -> None:
        """Wait until just these robots have links. A run may be over before the last link is up, since it goes around
        links that do not carry, and those of an earlier run stay for some seconds."""
        until(f"the links are {pairs}", lambda: self.links() == set(pairs), state=self.links)

    def _state(self) -> str:
        """What each robot has said last, and the links."""
        last = {}
        for name, robot in self.machines.items():
            lines = (robot.share / "said").read_text().splitlines()
            last[name] = lines[-1] if lines else ""
        return f"links {sorted(self.links())}, {last}"

    def until_recorded(self, name: str, shape: str, app: str, iteration: int) -> None:
        """The robot's recording has that iteration: what it does not have by now goes with a power cut."""
        path = self.machines[name].share / f"records-{shape}/{name}.{app}.mcap"
        until(
            f"{name}: iteration {iteration} is recorded",
            lambda: trajectory.read(path).last >= iteration,
            state=lambda: trajectory.read(path).last,
            every=0.1,
        )

    def end_run(self, shape: str) -> None:
        """What follows may begin."""
        for robot in self.machines.values():
            (robot.share / f"go-on-{shape}").unlink()

    def end(self) -> None:
        """All has ended, and well."""
        for name, number in self._commands.items():
            done = self.machines[name].wait(number, PATIENCE_S, "its services end")
            assert done.code == 0, (self.machines[name].share / "said").read_text()[-3000:]


@contextmanager
def swarm_of(image: Image, folder: Path, count: int) -> Iterator[Swarm]:
    """So many robots, and the air between them."""
    with Radio(folder, count, machines=True) as radio:
        made = Swarm(image, folder, count, radio)
        try:
            made.boot(*made.names)
            yield made
        finally:
            for machine in made.machines.values():
                machine.kill()


def simulate(folder: Path, shape: str) -> Run:
    """The same swarm in the simulation of this host."""
    own, record = folder / f"{shape}.toml", folder / "simulated" / shape
    own.write_text(config(shape, "insecure = true"))
    words = ["consensus", "--config", str(own), "--virtual", "--iterations", str(ITERATIONS), "--json"]
    command = [sys.executable, "-m", "laptop.cli.runs.sim", *words, "--record", str(record)]
    waiting.run(f"the simulation of {shape}", command)
    return Run(record)


def test_robots_in_machines_of_their_own_compute_what_the_simulation_computes(lab_image: Image, tmp_path: Path) -> None:
    with swarm_of(lab_image, tmp_path, ROBOTS) as swarm:
        texts = {shape: config(shape, KEY) for shape in SHAPES}
        swarm.begin(texts, f"consensus --iterations {ITERATIONS}", *swarm.names)
        for shape in SHAPES:
            for name in swarm.names:
                swarm.until(name, shape, lambda said: said["k"] >= ITERATIONS, f"at iteration {ITERATIONS}")
            swarm.wait_links(SHAPES[shape])
            swarm.end_run(shape)
        swarm.end()
        records = {name: robot.share for name, robot in swarm.machines.items()}
    for shape in SHAPES:
        simulated = simulate(tmp_path, shape).trajectories("consensus")
        for name, share in records.items():
            rows = Run(share / f"records-{shape}").trajectories("consensus")[name].rows
            for k in range(ITERATIONS + 1):
                assert rows[k] == simulated[name].rows[k], f"{shape}, {name}, iteration {k}"


def test_a_machine_that_loses_its_power_boots_and_joins_again(lab_image: Image, tmp_path: Path) -> None:
    """The others go on without it in a new epoch; nothing that anybody has computed is lost, doubled or forked."""
    starts = {f"r{i}": i / 3 for i in range(3)}
    values = "".join(
        f"[apps.restless.robots.{name}]\nvalue = {value!r}\nphase = {index}.0\n"
        for index, (name, value) in enumerate(starts.items())
    )
    texts = {"line": line(3, KEY, values)}
    words = f"/share/restless.py --absent drop --drop-after {DROP_AFTER_S}"
    with swarm_of(lab_image, tmp_path, 3) as swarm:
        for robot in swarm.machines.values():
            shutil.copy(Path(restless_rule.__file__).with_name("restless.py"), robot.share)
        swarm.begin(texts, words, *swarm.names)
        begun = [swarm.until(name, "line", lambda said: said["k"] >= 30, "at iteration 30") for name in swarm.names]
        swarm.until_recorded("r2", "line", "restless", 30)
        swarm.machines["r2"].kill()
        # The others may have gone on without a machine that started late: then there was an epoch of two before.
        epoch = max(said["epoch"] for said in begun)
        two = swarm.until(
            "r0",
            "line",
            lambda said: said["epoch"] > epoch and set(said["members"]) == {"r0", "r1"},
            "an epoch of two",
        )
        swarm.until("r0", "line", lambda said: said["k"] >= two["k"] + 30, "30 iterations of two")
        swarm.boot("r2")
        swarm.begin(texts, words, "r2")
        again = swarm.until("r2", "line", lambda said: said["epoch"] > two["epoch"] and said["k"] > 0, "a member again")
        assert set(again["members"]) == set(swarm.names)
        swarm.until("r2", "line", lambda said: said["k"] >= again["k"] + 30, "30 iterations of three")
        swarm.end_run("line")
        swarm.end()
        paths = {name: [robot.share / f"records-line/{name}.restless.mcap"] for name, robot in swarm.machines.items()}
    graph = Graph(tuple(swarm.names), [(f"r{i}", f"r{j}") for i, j in LINE[:2]])
    found = restless_rule.compare(restless_rule.read(paths, graph), starts)
    assert found.wrong == []
    assert found.compared > 3 * 60
    assert +found.anew == Counter(r2=1) or (epoch > 0 and found.anew["r2"] > 0)
