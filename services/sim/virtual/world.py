"""A swarm under virtual time: for each robot a bus, a mesh and the hosts of its apps, and the air between them."""

from collections.abc import Callable
from dataclasses import dataclass, field

from services.apps import loader, topology
from services.apps.runner import Runner
from services.mesh.core.delay import AirModel
from services.sim.virtual.air import Air
from services.sim.virtual.bus import VirtualBus, VirtualRouter
from services.sim.virtual.events import EventQueue
from services.sim.virtual.mesh import Common, VirtualMesh
from services.sim.virtual.sync import Line, Measurements, SyncHost
from swarm.app import SyncApp
from swarm.config import Config
from swarm.core.lockstep import Channel
from swarm.devices import Devices
from swarm.errors import AppError
from swarm.mesh_clock import MeshClock
from swarm.overlays import Overlays
from swarm.ranging import Ranging
from swarm.robot import Robot

ASK_EVERY = 0.2
"""s between two looks whether an automatic topology links all robots yet, as the real host has it."""

INCARNATION = 1
"""Of every app host: nobody is started anew."""


@dataclass
class VirtualRobot:
    """What there is of one robot."""

    name: str
    router: VirtualRouter
    mesh: VirtualMesh
    apps: dict[str, SyncHost] = field(default_factory=dict)


class World:
    """Robots and their links."""

    def __init__(self, config: Config, air: AirModel, seed: int) -> None:
        self.config = config
        self.seed = seed
        self.time = EventQueue()
        self.air = Air(self.time, air)
        self._common = Common(config)
        self.robots = {name: self._robot(name) for name in config.names}

    def cut(self, a: str, b: str, at: float, seconds: float) -> None:
        """Let nothing pass between two robots from `at` on."""
        self.time.at(at, self.air.cut, a, b, seconds)

    def start_app(
        self,
        robot: str,
        app: loader.App,
        *,
        run: int,
        last: int | None,
        measurements: Measurements | None,
        advanced: Callable[[SyncHost, Line], None],
        ended: Callable[[SyncHost], None],
    ) -> None:
        """Start an app's host; with an automatic topology it begins when that links all robots."""

        def begin() -> None:
            config, epoch = self.config, topology.CONFIGURED
            if config.auto:
                in_force = self.robots[robot].mesh.node.overlays.topology(self.time.now)
                if topology.lacking(config, in_force, self.time.now):
                    self.time.at(self.time.now + ASK_EVERY, begin)
                    return
                links = topology.of_edges(config, in_force.edges)
                config, epoch = links.config, links.epoch
            instance = app.make(config, robot, self.seed)
            if not isinstance(instance, SyncApp):
                raise AppError(f"app {app.name}: in virtual time only synchronous apps run")
            bus = VirtualBus(self.robots[robot].router)
            self._equip(instance.robot, bus, f"{run & 0xFFFFFFFFFFFF:012x}")
            runner = Runner(instance, app.source)
            host = self.robots[robot].apps[app.name] = SyncHost(
                app.name,
                robot,
                runner,
                config.graph.neighbours(robot),
                Channel(run, epoch, INCARNATION, runner.schema.hash),
                last=last,
                time=self.time,
                bus=bus,
                measurements=measurements,
                advanced=advanced,
                ended=ended,
            )
            host.start()

        self.time.soon(begin)

    def _equip(self, robot: Robot, bus: VirtualBus, prefix: str) -> None:
        """Put in what an app on a bus has: the clients that run on robots, told the virtual time."""

        def now() -> float:
            return self.time.now

        robot.time = now
        robot.bus = bus
        robot.overlays = Overlays(bus, robot.name, robot.app, now=now, prefix=prefix)
        robot.overlays.collect()
        robot.mesh_clock = MeshClock(bus, robot.name, now)
        robot.ranging = Ranging(bus, robot.name, now)
        robot.devices = Devices(bus, robot.name, now)

    def _robot(self, name: str) -> VirtualRobot:
        router = VirtualRouter(self.time)
        mesh = VirtualMesh(self._common, name, self.time, self.air, VirtualBus(router), self.seed)
        return VirtualRobot(name, router, mesh)
