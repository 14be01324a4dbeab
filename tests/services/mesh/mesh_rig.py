"""Real mesh processes with real buses, built for a test in any graph and over each kind of link."""

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from conftest import Processes, ask, stop, wait_until

from bench.rigs.ports import free_port
from services.mesh.core.wire import frames
from services.mesh.core.wire.frames import Hello
from swarm.bus.zenoh_bus import Bus, Router
from swarm.messages import LinkState, Status, read
from swarm.process.paths import bus_endpoint

SYNC = "swarm/{}/app/consensus/sync/00000000000000a1-0-3-9f3c21aa"
SHORT = "heartbeat = 0.1\nsuspect = 0.4\ndead = 2.0\n"
"""Shorter times than normal, so that tests of silence are short."""
PATIENT = "suspect = 20.0\ndead = 40.0\n"
"""Longer times than normal: a busy host stops a mesh for some seconds, which breaks no link of other tests."""


class Robot:
    """One robot's bus and mesh, and what a test sees of them."""

    def __init__(self, swarm: "Swarm", name: str) -> None:
        self.name = name
        self.swarm = swarm
        self.directory = swarm.runtime / name
        self.directory.mkdir()
        self.disk = self.directory / "disk"
        self.config = swarm.runtime / f"{name}.toml"
        self.samples: list[tuple[str, bytes]] = []
        self.links: dict[str, LinkState] = {}
        self.seen: list[tuple[str, str]] = []
        self.router = None if name in swarm.own_bus else Router(bus_endpoint(self.directory))
        self.bus = Bus.of(self.directory)
        self.bus.subscribe("swarm/*/app/**", lambda key, payload: self.samples.append((key, payload)))
        self.bus.subscribe(f"swarm/{name}/mesh/links", self._on_links)
        self.mesh: subprocess.Popen[str] | None = None

    def start(self) -> subprocess.Popen[str]:
        self.mesh = self.swarm.processes.start_ready(
            "-m",
            "services.mesh",
            SWARM_ROBOT=self.name,
            SWARM_RUNTIME=str(self.directory),
            SWARM_STATE=str(self.disk),
            SWARM_CONFIG=str(self.config),
            SWARM_SIM_LINK=self.swarm.model,
        )
        return self.mesh

    def _on_links(self, key: str, payload: bytes) -> None:
        for link in read(key, payload).links:
            self.links[link.peer] = link
            if self.seen[-1:] != [(link.peer, link.state)]:
                self.seen.append((link.peer, link.state))

    def status(self) -> Status:
        key = f"swarm/{self.name}/mesh/status"
        return read(key, ask(self.bus, key))

    def close(self) -> None:
        self.bus.close()
        if self.router is not None:
            self.router.close()


class Swarm:
    """Robots in one runtime directory."""

    def __init__(
        self,
        processes: Processes,
        kind: str,
        edges: list[tuple[str, str]],
        extra: str,
        model: str,
        times: str,
        key: Path | None,
        auto: bool = False,
        own_bus: tuple[str, ...] = (),
    ) -> None:
        """Robots of `own_bus` get no router here."""
        self.key = key
        self.own_bus = own_bus
        self.auto = auto
        self.processes = processes
        self.runtime = processes.runtime
        self.model = model
        names = sorted({name for edge in edges for name in edge})
        self.ports = {name: free_port() for name in names}
        self.robots = {name: Robot(self, name) for name in names}
        self.edges = edges
        for name, robot in self.robots.items():
            robot.config.write_text(self._config(kind, name, extra, times))

    def _config(self, kind: str, me: str, extra: str, times: str) -> str:
        topology = f"[topology]\nedges = {[list(edge) for edge in self.edges]}\n"
        text = f'network = "test"\n{extra}' + ('topology = "auto"\n' if self.auto else topology)
        for name in self.robots:
            link = f"sim:{self.runtime}/{name}/mesh.sock" if kind == "sim" else f"tcp:127.0.0.1:{self.ports[name]}"
            text += f'[[robots]]\nname = "{name}"\nlink = "{link}"\n'
        text += f'[mesh]\nkey = "{self.key}"\n{times}' if self.key else f"[mesh]\ninsecure = true\n{times}"
        return text + (f'listen = "127.0.0.1:{self.ports[me]}"\n' if kind == "tcp" else "")

    def start(self) -> None:
        for robot in self.robots.values():
            robot.start()
        self.wait_up()

    def wait_up(self) -> None:
        def up() -> bool:
            pairs = [pair for a, b in self.edges for pair in ((a, b), (b, a))]
            return all(peer in self[name].links and self[name].links[peer].state == "up" for name, peer in pairs)

        wait_until(up, what="all links are up")

    def talk(self, sender: str, receiver: str, key: str = "", payload: bytes = b"hello") -> None:
        """Publish until it arrives: while a link or a bus returns, messages may be lost."""
        key = key or SYNC.format(sender)

        def arrived() -> bool:
            self[sender].bus.publish(key, payload)
            return (key, payload) in self[receiver].samples

        self[receiver].samples.clear()
        wait_until(arrived, what=f"{key} arrives at {receiver}")

    def __getitem__(self, name: str) -> Robot:
        return self.robots[name]

    def close(self) -> None:
        self.processes.end()
        for robot in self.robots.values():
            robot.close()


Build = Callable[..., Swarm]


@pytest.fixture
def build(processes: Processes) -> Iterator[Build]:
    built: list[Swarm] = []

    def make(
        kind: str = "sim",
        edges: tuple[tuple[str, str], ...] = (("r0", "r1"),),
        extra: str = "",
        model: str = "",
        times: str = PATIENT,
        key: Path | None = None,
        auto: bool = False,
        own_bus: tuple[str, ...] = (),
    ) -> Swarm:
        built.append(Swarm(processes, kind, list(edges), extra, model, times, key, auto, own_bus))
        return built[-1]

    yield make
    for swarm in built:
        swarm.close()


def log_of(process: subprocess.Popen[str]) -> str:
    """Stop a service and return what it logged."""
    assert stop(process) == 0
    return process.communicate()[1]


def hello(**changes: object) -> bytes:
    values = {"network": "test", "robot": "r0", "incarnation": 0, "nonce": bytes(16), "dialler": True, "insecure": True}
    return frames.encode_hello(Hello(**(values | changes)))  # type: ignore[arg-type]
