"""A swarm under virtual time: for each robot a bus with mesh, balancer, dwm and the hosts of its apps; and the air."""

import logging
import random
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from services.apps import loader, topology
from services.apps.event_runner import EventRunner
from services.apps.runner import Runner
from services.mesh.core.radio_model import AirModel
from services.mesh.core.routing.link_state import Known
from services.mesh.core.wire.packets import Advertisement
from sim.core.actions import Act
from sim.core.witness import Witness
from sim.options import DELAY, FROM_START, SETTLED
from sim.virtual.air import Air
from sim.virtual.balancer import VirtualBalancer
from sim.virtual.body import DIFFERENTIAL
from sim.virtual.bus import VirtualBus, VirtualRouter
from sim.virtual.delays import DelayMesh
from sim.virtual.event_host import VirtualEventHost
from sim.virtual.events import EventQueue, LocalTime, Time
from sim.virtual.host import Place, VirtualHost
from sim.virtual.measurements import Live, Replayed
from sim.virtual.mesh import FIRST_INCARNATION, Common, VirtualMesh
from sim.virtual.strand import Measurements, Told
from sim.virtual.uwb import ModuleField, VirtualDwm
from swarm.app.devices import Devices
from swarm.app.event_app import Channel, EventApp, channels_of
from swarm.app.mesh_clock import MeshClock
from swarm.app.overlays import Overlays
from swarm.app.ranging import Ranging
from swarm.app.robot import Robot
from swarm.app.run_options import Conduct
from swarm.app.sync_app import SyncApp
from swarm.config import Config
from swarm.core.epoch_notes import Epoch, Kept, first
from swarm.core.graph import Graph
from swarm.errors import AppError
from swarm.messages import Target
from swarm.messages.codec import Value
from swarm.messages.keys import key
from swarm.recording.thesis_ranges import Recording

ASK_EVERY = 0.2
"""s between two looks whether an automatic topology links all robots yet, as the real host has it."""

TARGET_PERIOD_S = 0.1
"""s between two messages of where a target that moves is, as the real simulation has it."""

LONGEST_UP = 3600.0
"""s since when robots may be up whose clocks are not one: so far their zeros lie apart."""


@dataclass
class VirtualRobot:
    """What there is of one robot."""

    name: str
    router: VirtualRouter
    mesh: VirtualMesh | DelayMesh
    meshes_bus: VirtualBus
    """Where the messages of others appear."""
    balancer: VirtualBalancer
    dwm: VirtualDwm
    time: Time
    """Its clock."""
    apps: dict[str, VirtualHost | VirtualEventHost] = field(default_factory=dict)
    starts: int = 1
    """How often it was switched on."""
    sent_before: int = 0
    """Messages of meshes that have ended."""

    @property
    def sent(self) -> int:
        """Messages of its apps that left, counted once for each neighbour."""
        return self.sent_before + self.mesh.sent


class Launch(NamedTuple):
    """How an app's hosts are started."""

    app: loader.App
    run: int
    conduct: Conduct
    recording: Recording | None
    """That the app replays."""
    told: Told


class World:
    """Robots and their links."""

    def __init__(
        self,
        config: Config,
        air: AirModel,
        seed: int,
        *,
        body: str = DIFFERENTIAL,
        mesh: str = FROM_START,
        lying: str | None = None,
        skew: float = 0.0,
        witness: Witness | None = None,
    ) -> None:
        """`body`: which model of `sim.virtual.body`; `mesh`: one of `options.MESHES`; `lying`: the side on
        which robots begin, if they do not stand; `skew`: how far the rates of their clocks err at most, 1e-6 = 1 ppm
        (then their zeros differ, too); `witness`: who is told what is to be seen."""
        self.config = config
        self.seed = seed
        self.time = EventQueue()
        self.air = Air(self.time, air)
        self.modules = ModuleField(config)
        self._model = air
        self._mesh = mesh
        self.records: dict[tuple[str, str], Callable[[str, float, Value], None]] = {}
        """By robot and app, what `robot.record` calls, where the run is recorded."""
        self._body = body
        self._lying = lying
        self._skew = skew
        self._witness = witness
        self._names = frozenset(config.names)
        self._launched: dict[tuple[str, str], Launch] = {}
        self._begin_with: dict[int, tuple[Epoch, Graph]] = {}
        self._common = Common(config)
        self.robots = {name: self._robot(name) for name in config.names}
        if mesh == SETTLED:
            self._settle(air.latency)
        meshes = {name: robot.mesh for name, robot in self.robots.items() if isinstance(robot.mesh, DelayMesh)}
        for each in meshes.values():
            each.link(meshes, self.air.cuts)
        if config.simulation.moving:
            self.time.soon(self._tell_target)

    def cut(self, a: str, b: str, at: float, seconds: float) -> None:
        """Let nothing pass between two robots from `at` on."""
        self.time.at(at, self.air.cut, a, b, seconds)

    def switch_off(self, robot: str, seconds: float) -> None:
        """Switch a robot off: its mesh and its apps end at once, and with them what they knew, but for its votes. After
        `seconds` they start anew. The body stays as it is."""
        there = self.robots[robot]
        begun = [
            (self._launched[robot, app], host.kept) for app, host in there.apps.items() if isinstance(host, VirtualHost)
        ]
        for host in there.apps.values():
            assert isinstance(host, VirtualHost)  # `Run` lets no other app be switched off
            host.close()
        there.apps.clear()
        if isinstance(there.mesh, VirtualMesh):
            there.sent_before += there.mesh.sent
            there.mesh.kill()
        else:
            for peer in self._common.near[robot]:
                self.air.cut(robot, peer, seconds)
        self.time.at(self.time.now + seconds, self._switch_on, robot, begun)

    def _switch_on(self, robot: str, begun: list[tuple[Launch, Kept | None]]) -> None:
        there = self.robots[robot]
        there.starts += 1
        if isinstance(there.mesh, VirtualMesh):
            there.meshes_bus = VirtualBus(there.router)
            there.mesh = VirtualMesh(
                self._common, robot, there.time, self.air, there.meshes_bus, self.seed, incarnation=there.starts
            )
        for launch, kept in begun:
            self._begin(robot, launch, kept)

    def act(self, robot: str, at: float, act: Act) -> None:
        """Let a person do something to a robot."""
        self.time.at(at, self.robots[robot].balancer.act, act)

    def start_app(self, robot: str, launch: Launch, after: float = 0.0) -> None:
        """Start an app's host after so many s; with an automatic topology it begins when that links all robots."""
        self._launched[robot, launch.app.name] = launch
        if after:
            self.time.at(self.time.now + after, self._begin, robot, launch)
        else:
            self.time.soon(self._begin, robot, launch)

    def _begin(self, robot: str, launch: Launch, kept: Kept | None = None) -> None:
        app, run, conduct, recording, told = launch
        config, epoch = self.config, topology.CONFIGURED
        if config.auto:
            mesh = self.robots[robot].mesh
            assert isinstance(mesh, VirtualMesh)  # an automatic topology is found by meshes
            in_force = mesh.look(lambda overlays, now: overlays.topology(now))
            if topology.lacking(config, in_force, self.robots[robot].time.now):
                self.time.at(self.time.now + ASK_EVERY, self._begin, robot, launch, kept)
                return
            links = topology.of_edges(config, in_force.edges)
            config, epoch = links.config, links.epoch
        instance = app.make(config, robot, self.seed)
        bus = VirtualBus(self.robots[robot].router)
        if epoch not in self._begin_with:
            self._begin_with[epoch] = first(config.names, config.edges, epoch), config.graph
        there = self.robots[robot]
        begin = self._begin_with[epoch]
        place = Place(robot, self._names, *begin, run, conduct, there.time, bus, there.starts, kept)
        self._equip(instance.robot, bus, place.prefix)
        host: VirtualHost | VirtualEventHost
        if isinstance(instance, EventApp):
            host = self._event_host(app, instance, place, told)
        else:
            assert isinstance(instance, SyncApp)
            measurements: Measurements | None = None
            if instance.measured:
                measurements = Replayed(recording) if recording is not None else self._live(robot, bus)
            assert instance.robot.overlays is not None
            instance.robot.overlays.collect()
            host = VirtualHost(
                app.name, {"": Runner(instance, app.source, conduct.tolerance)}, app.digest, place, measurements, told
            )
        there.apps[app.name] = host
        host.start()

    def _event_host(self, app: loader.App, instance: EventApp, place: Place, told: Told) -> VirtualEventHost:
        names = channels_of(type(instance))
        channels: dict[str, Channel] = {name: getattr(instance, name) for name in names}
        inner: VirtualHost | None = None
        if channels:
            for each in channels.values():
                self._equip(each.app.robot, place.bus, place.prefix)
            runners = {name: Runner(each.app, app.source, place.conduct.tolerance) for name, each in channels.items()}
            latest = {name: _taking(each) for name, each in channels.items()}
            endless = place._replace(conduct=replace(place.conduct, last=None, rule=None))
            inner = VirtualHost(
                app.name,
                runners,
                app.digest,
                endless,
                None,
                told,
                latest,
            )
        return VirtualEventHost(
            app.name, EventRunner(instance, app.source), app.digest, place, self.config, inner, told
        )

    def _tell_target(self) -> None:
        """Where a target that moves is, for recordings."""
        now = self.time.now
        self.time.at(now + TARGET_PERIOD_S, self._tell_target)
        place = Target(now, *self.config.simulation.target_after(now - self.modules.moves_from))
        for name, robot in self.robots.items():
            robot.dwm.bus.publish(key(name, "sim", "target"), place)

    def _live(self, robot: str, bus: VirtualBus) -> Live:
        if self.config.dwm.target is None:
            raise AppError("[dwm] target: expected the address of the target's module, this app needs it")
        return Live(bus, robot, self.config.dwm.target)

    def _equip(self, robot: Robot, bus: VirtualBus, prefix: str) -> None:
        """Put in what an app on a bus has: the clients that run on robots, told the virtual time."""

        time = self.robots[robot.name].time

        def now() -> float:
            return time.now

        robot.log = logging.getLogger(robot.name)
        robot.time = now
        robot.bus = bus
        robot.overlays = Overlays(bus, robot.name, robot.app, now=now, prefix=prefix)
        robot.mesh_clock = MeshClock(bus, robot.name, now)
        robot.ranging = Ranging(bus, robot.name, now)
        robot.devices = Devices(bus, robot.name, now)
        robot.recording = self.records.get((robot.name, robot.app))

    def _settle(self, latency: float) -> None:
        times = round(max(latency * 1e4, 1.0))
        links = {name: dict.fromkeys(near, times) for name, near in self._common.near.items()}
        known = {name: Known(FIRST_INCARNATION, Advertisement(near), 0.0) for name, near in links.items()}
        for robot in self.robots.values():
            assert isinstance(robot.mesh, VirtualMesh)
            robot.mesh.look(lambda overlays, now: overlays.settle(links, known, now))

    def _robot(self, name: str) -> VirtualRobot:
        router = VirtualRouter(self.time)
        time: Time = self.time
        if self._skew:
            numbers = random.Random(f"{self.seed} {name} clock")
            time = LocalTime(self.time, numbers.uniform(0.0, LONGEST_UP), numbers.uniform(-self._skew, self._skew))
        meshes_bus, bus = VirtualBus(router), VirtualBus(router)
        mesh: VirtualMesh | DelayMesh
        if self._mesh == DELAY:
            mesh = DelayMesh(self.config, name, self._common.near[name], self._model, self.time, meshes_bus)
        else:
            mesh = VirtualMesh(self._common, name, time, self.air, meshes_bus, self.seed)
        balancer = VirtualBalancer(self.config, name, self._body, time, bus, self.seed, self._witness)
        if self._lying is not None:
            balancer.body.lay(self._lying, time.now)
        dwm = VirtualDwm(
            self.config, self._common.robots[name], self.modules, balancer, time, VirtualBus(router), self.seed
        )
        return VirtualRobot(name, router, mesh, meshes_bus, balancer, dwm, time)


def _taking(channel: Channel) -> Callable[[int, bytes], None]:
    """Hands a channel's new states to the app that it belongs to."""
    schema = type(channel.app).spec.schema

    def take(k: int, state: bytes) -> None:
        channel.take(k, dict(zip(schema.names, schema.unpack(state), strict=True)))

    return take
