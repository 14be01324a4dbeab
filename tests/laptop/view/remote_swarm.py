"""Real robots of a test: a real ssh server each, a bus, and real meshes between them."""

import os
from pathlib import Path
from typing import Any

import pytest
from conftest import Processes
from needs import needs_ssh
from remote_units import Units, scripts

from bench.rigs.fake_robots import FakeRobots
from laptop.fleet.ssh.ssh import Ssh, hosts
from laptop.view.actions.control import Control
from laptop.view.actions.remote_actions import RemoteActions
from laptop.view.feeds.robots import Robots
from swarm.bus.zenoh_bus import Bus, Router
from swarm.config import load
from swarm.process.paths import bus_endpoint

real_page = [
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    needs_ssh,
]
"""Marks of tests that show real robots in a real browser."""

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
        self.units: dict[str, Units] = {}
        """Stand-ins for systemd, of the robots that have one."""
        self.config = self.runtime / "robots.toml"
        """What their meshes go by."""
        self._views: list[Robots] = []
        self._controls: list[Control] = []

    def add(self, name: str, *, ssh: bool = True, bus: bool = True, **options: Any) -> None:
        (self.runtime / name).mkdir()
        hook = f"export PYTHONPATH={os.environ.get('PYTHONPATH', os.getcwd())}"  # noqa: PTH109
        self.far.add(name, hook=hook, up=ssh, **options)
        for program, text in scripts(self.runtime / name, self.far.config).items():
            self.far.script(name, program, text)
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
            if name in self.units:
                self.units[name].start("swarm-mesh.service")
            else:
                self.meshes[name] = self.start(name, "services.mesh")

    def supervise(self, name: str) -> None:
        """Have a robot's services started, and started again when they die."""
        self.units[name] = Units(self.far.folder / name, self.processes, self._environment(name))

    def start(self, name: str, module: str, *arguments: object) -> Any:
        """Start a service of a robot."""
        return self.processes.start("-m", module, *map(str, arguments), **self._environment(name))

    def _environment(self, name: str) -> dict[str, str]:
        runtime = str(self.runtime / name)
        return {"SWARM_ROBOT": name, "SWARM_RUNTIME": runtime, "SWARM_CONFIG": str(self.config)}

    def view(self, *names: str) -> Robots:
        self.far.ready()
        config = load(self.far.config)
        self._views.append(Robots(config, hosts(config, names), Ssh(self.far.ssh_config)))
        return self._views[-1]

    def control(self, view: Robots) -> Control:
        """Of a view."""
        self._controls.append(Control(view, RemoteActions(view, Ssh(self.far.ssh_config))))
        return self._controls[-1]

    def close(self) -> None:
        for control in self._controls:
            control.close()
        for view in self._views:
            view.close()
        self.far.close()
        for units in self.units.values():
            units.close()
        self.processes.end()
        for each in (*self.buses.values(), *self.routers.values()):
            each.close()
