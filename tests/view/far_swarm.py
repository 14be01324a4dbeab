"""Real robots of a test: a real ssh server each, a bus, and real meshes between them."""

import os
import sys
from pathlib import Path
from typing import Any

from conftest import Processes

from bench.fake_robots import FakeRobots
from swarm.bus import Bus, Router
from swarm.config import load
from swarm.fleet.ssh import Ssh, hosts
from swarm.paths import bus_endpoint
from swarm.view.robots import Robots

FAR = """shift; shift; echo $$ >> $HOME/started
SWARM_RUNTIME={runtime} exec {python} "$@"
"""
MESH = "[mesh]\ninsecure = true\nheartbeat = 0.1\nsuspect = 0.4\ndead = 1.0\n"
LINE = '[topology]\nshape = "line"\n'


class Swarm:
    """Robots with a bus each, and meshes where a test wants them; ssh leads to those that it names."""

    def __init__(self, processes: Processes, folder: Path) -> None:
        self.processes = processes
        self.runtime = processes.runtime
        self.far = FakeRobots(folder)
        self.routers: dict[str, Router] = {}
        self.buses: dict[str, Bus] = {}
        self.meshes: dict[str, Any] = {}
        self.config = self.runtime / "robots.toml"
        """What their meshes go by."""
        self._views: list[Robots] = []

    def add(self, name: str, *, ssh: bool = True, bus: bool = True, **options: Any) -> None:
        (self.runtime / name).mkdir()
        hook = f"export PYTHONPATH={os.environ.get('PYTHONPATH', os.getcwd())}"  # noqa: PTH109
        self.far.add(name, hook=hook, up=ssh, **options)
        self.far.script(name, "sudo", FAR.format(python=sys.executable, runtime=self.runtime / name))
        if bus:
            self.start_bus(name)

    def start_bus(self, name: str) -> None:
        self.routers[name] = Router(bus_endpoint(self.runtime / name))
        if name not in self.buses:
            self.buses[name] = Bus.of(self.runtime / name)

    def lookout(self, name: str) -> int:
        """The process that tells what a robot's bus says."""
        return int((self.far.folder / name / "started").read_text().split()[-1])

    def stop_bus(self, name: str) -> None:
        self.routers.pop(name).close()

    def start_meshes(self) -> None:
        """Of all robots, in a line in the order in which they were added."""
        names = list(self.buses)
        text = "".join(f'[[robots]]\nname = "{name}"\nlink = "sim:{self.runtime}/{name}/mesh.sock"\n' for name in names)
        self.config.write_text(f'network = "test"\n{LINE}{text}{MESH}')
        for name in names:
            self.meshes[name] = self.start(name, "services.mesh")

    def start(self, name: str, module: str, *arguments: object) -> Any:
        """Start a service of a robot."""
        environment = {"SWARM_ROBOT": name, "SWARM_RUNTIME": str(self.runtime / name), "SWARM_CONFIG": str(self.config)}
        return self.processes.start("-m", module, *map(str, arguments), **environment)

    def view(self, *names: str) -> Robots:
        self.far.ready()
        config = load(self.far.config)
        self._views.append(Robots(config, hosts(config, ",".join(names)), Ssh(self.far.ssh_config)))
        return self._views[-1]

    def close(self) -> None:
        for view in self._views:
            view.close()
        self.far.close()
        self.processes.end()
        for each in (*self.buses.values(), *self.routers.values()):
            each.close()
