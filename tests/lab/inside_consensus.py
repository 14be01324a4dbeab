"""Inside a machine: six robots' processes over RFCOMM compute bit for bit what the simulation computed on the host."""

import json
import subprocess
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from conftest import Processes, stop, wait_until
from inside_radio import adapters, bring_up, hci

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
        self.mesh: dict[str, subprocess.Popen[str]] = {}
        self.apps: dict[str, subprocess.Popen[str]] = {}
        for name in NAMES:
            directory = processes.runtime / name
            directory.mkdir()
            self.routers.append(Router(bus_endpoint(directory)))
            self.buses[name] = Bus.of(directory)
            self.buses[name].subscribe(f"swarm/{name}/app/consensus/state", self._on_state)

    def _on_state(self, key: str, payload: bytes) -> None:
        self.reached[key.split("/")[1]] = read(key, payload).k

    def start(self, module: str, name: str, *words: str) -> subprocess.Popen[str]:
        return self.processes.start_ready(
            "-m", module, *words,
            SWARM_ROBOT=name,
            SWARM_RUNTIME=str(self.processes.runtime / name),
            SWARM_CONFIG=str(SHARE / f"{self.shape}.toml"),
            SWARM_RECORD=str(self.records),
        )  # fmt: skip

    def start_mesh(self, name: str) -> None:
        self.mesh[name] = self.start("services.mesh", name)

    def start_app(self, name: str, iterations: int) -> None:
        words = ("consensus", "--iterations", str(iterations), "--run", "1ab")
        self.apps[name] = self.start("services.apps", name, *words)

    def run(self, iterations: int) -> None:
        with ThreadPoolExecutor(3) as pool:
            list(pool.map(self.start_mesh, NAMES))
            list(pool.map(lambda name: self.start_app(name, iterations), NAMES))

    def finish(self, iterations: int) -> None:
        wait_until(lambda: min(self.reached.values()) >= iterations, 40, f"all reach {iterations}: {self.reached}")
        for process in (*self.apps.values(), *self.mesh.values()):
            if process.poll() is None:
                stop(process, 60)

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


def test_cuts_lost_adapters_and_killed_meshes_change_no_bit(swarm: Swarm, radio: Radio) -> None:
    iterations = 5 * ITERATIONS
    radio.order("medium", latency=0.03)  # so that it lasts
    swarm.run(iterations)

    def more(count: int = 5) -> None:
        """It goes on: everybody gets that much farther, and there is still something to break."""
        before = max(swarm.reached.values())
        wait_until(lambda: min(swarm.reached.values()) >= before + count, 40, f"more: {swarm.reached}")
        assert max(swarm.reached.values()) < iterations

    more()
    radio.order("cut", one=radio.addresses[0], other=radio.addresses[1])
    time.sleep(2.0)
    radio.order("mend", one=radio.addresses[0], other=radio.addresses[1])
    more()
    radio.order("drop", one=radio.addresses[2], other=radio.addresses[3])
    more()
    radio.order("silence", address=radio.addresses[4])
    time.sleep(6.0)  # beyond the supervision time: the kernel ends the links
    radio.order("unsilence", address=radio.addresses[4])
    more()
    hci(adapters()[radio.addresses[1]], "down")
    bring_up(radio)
    more()
    swarm.mesh["r2"].kill()
    swarm.mesh["r2"].wait()
    swarm.start_mesh("r2")
    more()
    swarm.apps["r3"].kill()
    swarm.apps["r3"].wait()
    swarm.start_app("r3", iterations)
    swarm.finish(iterations)
    compare(swarm, iterations)
    (SHARE / "counts.json").write_text(json.dumps(radio.order("look")["counts"]))
