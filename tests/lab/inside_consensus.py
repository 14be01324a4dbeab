"""Inside a machine: six robots' processes over RFCOMM compute bit for bit what the simulation computed on the host."""

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Processes, wait_until

from lab.radio.remote import Radio
from lab.shapes import ITERATIONS, ROBOTS, SHAPES
from swarm.bus import Bus, Router
from swarm.messages import read
from swarm.paths import bus_endpoint
from swarm.recording.run import Run

NAMES = [f"r{i}" for i in range(ROBOTS)]
SHARE = Path("/share")


class Swarm:
    """Mesh and consensus of six robots, with buses of this process."""

    def __init__(self, processes: Processes, shape: str) -> None:
        self.processes = processes
        self.shape = shape
        self.records = processes.runtime / "records"
        self.records.mkdir()
        self.routers: list[Router] = []
        self.buses: dict[str, Bus] = {}
        self.reached: dict[str, int] = dict.fromkeys(NAMES, -1)
        self.mesh: dict[str, int] = {}
        self.apps: dict[str, int] = {}
        self.nursery = processes.start(str(Path(__file__).with_name("inside_nursery.py")))
        for name in NAMES:
            directory = processes.runtime / name
            directory.mkdir()
            self.routers.append(Router(bus_endpoint(directory)))
            self.buses[name] = Bus.of(directory)
            self.buses[name].subscribe(f"swarm/{name}/app/consensus/state", self._on_state)

    def _on_state(self, key: str, payload: bytes) -> None:
        self.reached[key.split("/")[1]] = read(key, payload).k

    def start(self, module: str, name: str, *words: str) -> int:
        """The process id of a service that has begun to start."""
        environment = {
            "SWARM_ROBOT": name,
            "SWARM_RUNTIME": str(self.processes.runtime / name),
            "SWARM_CONFIG": str(SHARE / f"{self.shape}.toml"),
            "SWARM_RECORD": str(self.records),
        }
        order = json.dumps({"environment": environment, "module": module, "words": words})
        stdin, stdout = self.nursery.stdin, self.nursery.stdout
        assert stdin is not None
        assert stdout is not None
        stdin.write(order + "\n")
        stdin.flush()
        return int(stdout.readline())

    def start_mesh(self, name: str) -> None:
        self.mesh[name] = self.start("services.mesh", name)

    def start_app(self, name: str, iterations: int) -> None:
        words = ("consensus", "--iterations", str(iterations), "--run", "1ab")
        self.apps[name] = self.start("services.apps", name, *words)

    def run(self, iterations: int) -> None:
        for name in NAMES:
            self.start_mesh(name)
        for name in NAMES:
            self.start_app(name, iterations)

    def finish(self, iterations: int) -> None:
        wait_until(lambda: min(self.reached.values()) >= iterations, 40, f"all reach {iterations}: {self.reached}")
        for process in (*self.apps.values(), *self.mesh.values()):
            os.kill(process, signal.SIGTERM)
        for process in (*self.apps.values(), *self.mesh.values()):
            wait_until(lambda process=process: not Path(f"/proc/{process}").exists(), 40, "a service ends")

    def close(self) -> None:
        self.processes.end()
        for bus in self.buses.values():
            bus.close()
        for router in self.routers:
            router.close()


@pytest.fixture
def swarm(processes: Processes, request: pytest.FixtureRequest) -> Iterator[Swarm]:
    made = Swarm(processes, getattr(request, "param", "line"))
    yield made
    made.close()


def rows(folder: Path) -> dict[str, dict[int, tuple[str, ...]]]:
    """Of each robot, state and result of each iteration as text that is equal where the bits are."""
    return {robot: each.rows for robot, each in Run(folder).trajectories("consensus").items()}


def compare(swarm: Swarm, iterations: int) -> None:
    simulated, found = rows(SHARE / "simulated" / swarm.shape), rows(swarm.records)
    assert set(found) == set(NAMES)
    for name in NAMES:
        for k in range(iterations + 1):
            assert found[name][k] == simulated[name][k], f"{name}, iteration {k}"


@pytest.mark.parametrize("swarm", SHAPES, indirect=True)
def test_trajectories_are_those_of_the_simulation(swarm: Swarm, radio: Radio) -> None:
    swarm.run(ITERATIONS)
    swarm.finish(ITERATIONS)
    compare(swarm, ITERATIONS)
    links = {tuple(pair) for pair in radio.order("look")["links"]}
    assert links <= {(radio.addresses[i], radio.addresses[j]) for i, j in SHAPES[swarm.shape]}
