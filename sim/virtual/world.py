"""A swarm under virtual time: for each robot a bus with mesh, balancer, dwm and the hosts of its apps; and the air."""

import logging
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

from services.apps import loader
from services.apps.equipment.equipment import equip
from services.apps.equipment.measurements import Measurements, Replayed, source_of
from services.apps.equipment.recorded_values import RecordedValues
from services.apps.equipment.speaker import Sink, Speaker, let_speak
from services.apps.event_runner import EventRunner
from services.apps.host import topology
from services.apps.host.event_host import EventHost
from services.apps.host.host import LockstepHost, Part
from services.apps.host.observer import Observer
from services.apps.runner import AppRunner, Runner, metrics_of
from services.dwm.replay import answer_row
from services.mesh.core.routing.link_state import AdvertisedLinks
from services.mesh.core.routing.topology import Advertisement
from services.mesh.links.radio_model import AirModel
from sim.core.actions import SimulationAction
from sim.core.scene_record import SceneRecord
from sim.disturbances import NOT_RUNNING, SWITCHED_OFF
from sim.scenario.options import DELAY, SETTLED
from sim.scene import contacts_of
from sim.slots.parameters import SlotParameters
from sim.virtual.apps.storage import MemoryStorage
from sim.virtual.bus import VirtualBus, VirtualRouter
from sim.virtual.events import EventQueue, LocalTime, Time
from sim.virtual.radio.air import Air, Medium
from sim.virtual.radio.delays import DelayMesh
from sim.virtual.radio.mesh import FIRST_INCARNATION, Common, VirtualMesh
from sim.virtual.radio.slot_air import SlotAir
from sim.virtual.robot.balancer import VirtualBalancer
from sim.virtual.robot.body import DIFFERENTIAL
from sim.virtual.robot.contacts import ContactWatch
from sim.virtual.robot.uwb import ModuleField, VirtualDwm
from sim.virtual.runtime import VirtualRuntime
from swarm.app.event_app import EventApp
from swarm.app.run_options import RunOptions
from swarm.app.sync_app import BaseApp, SyncApp
from swarm.app.truth import RobotTruth, told
from swarm.config import Config
from swarm.errors import LocalError
from swarm.messages import Measurement, Target
from swarm.messages.codec import Value
from swarm.messages.keys import key

TARGET_PERIOD_S = 0.1
"""Seconds between two messages of where a target that moves is, as the real simulation has it."""

RESTART_DELAY_S = 0.2
"""Seconds after which a process that has ended is started again, as RestartSec in the units of deploy/systemd."""

LONGEST_UP = 3600.0
"""Largest difference of the zeros of clocks, where each robot has its own, s: so long ago a robot was switched on."""


@dataclass
class VirtualRobot:
    """The parts of one virtual robot."""

    name: str
    router: VirtualRouter
    mesh: VirtualMesh | DelayMesh
    meshes_bus: VirtualBus
    """The session on which the messages of others appear."""
    balancer: VirtualBalancer
    dwm: VirtualDwm
    time: Time
    """The robot's clock."""
    storage: MemoryStorage
    """The storage of its apps."""
    apps: dict[str, LockstepHost | EventHost] = field(default_factory=dict)
    buses: dict[str, VirtualBus] = field(default_factory=dict)
    """The session of each app."""
    speakers: dict[str, Speaker] = field(default_factory=dict)
    """What tells the lines of each app."""
    off_until: float = 0.0
    """The end of its last time without power."""
    starts: int = 1
    """How often it was switched on, or a process of it started again."""
    sent_before: int = 0
    """The number of messages of its meshes that have ended."""

    @property
    def sent(self) -> int:
        """Messages of its apps that left, counted once for each neighbour."""
        return self.sent_before + self.mesh.sent


Rows = Callable[[int], Measurement | None]
"""The measurement of each step, in place of what the module reports; None behind the last one."""

MakeRunner = Callable[[Any, str], AppRunner]
"""What makes the runner of an app, of its instance and the path of its file."""


class Launch(NamedTuple):
    """The way to start an app's hosts."""

    app: loader.LoadedApp
    run: int
    run_options: RunOptions
    rows: Rows | None
    """The measurements that the app replays."""
    observer: Observer | None
    runner: MakeRunner | None = None
    """What makes the runner, in place of `EventRunner` or `Runner`."""


class VirtualWorld:
    """Robots and their links."""

    def __init__(
        self,
        config: Config,
        air: AirModel,
        seed: int,
        *,
        body: str = DIFFERENTIAL,
        mesh: str,
        lying: str | None = None,
        skew: float = 0.0,
        scene_record: SceneRecord | None = None,
        slots: SlotParameters | None = None,
        processes_end: bool = False,
    ) -> None:
        """`body`: which model of `sim.virtual.robot.body`; `mesh`: one of `options.MESHES`; `lying`: the side on
        which robots begin, if they do not stand; `skew`: how far the rates of their clocks err at most, 1e-6 = 1 ppm
        (then their zeros differ, too); `scene_record`: who is told what is to be seen;
        `slots`: the radio of links whose addresses are `slots:`, in place of `air`; `processes_end`: apps keep what a
        process that is killed leaves to the next."""
        self.config = config
        self.seed = seed
        self.time = EventQueue()
        self.air: Medium = Air(self.time, air)
        if slots is not None:
            self.air = SlotAir(self.time, config.names, slots, seed)
        self.modules = ModuleField(config)
        self._model = air
        self._mesh = mesh
        self.records: dict[tuple[str, str], Callable[[str, float, Value], None]] = {}
        """Functions that `robot.record` calls where the run is recorded, by robot and app."""
        self.watched = False
        """Whether somebody looks at the run: then values that apps record go on the bus, too, as on a robot."""
        self.hearers: dict[tuple[str, str], list[Sink]] = {}
        """Receivers of what an app prints and logs, by robot and app."""
        self._body = body
        self._lying = lying
        self._skew = skew
        self._scene_record = scene_record
        self._processes_end = processes_end
        self._launched: dict[tuple[str, str], Launch] = {}
        self._told: dict[str, Mapping[str, Mapping[str, Value]]] = {}
        """The common part of the truth of all robots, by app: the values with which they begin."""
        self._begin_with: dict[tuple[str, int, int], topology.RunPlace] = {}
        self._common = Common(config)
        self.robots = {name: self._robot(name) for name in config.names}
        self.contacts = contacts_of(config)
        ContactWatch(self.time, self.contacts, {name: robot.balancer for name, robot in self.robots.items()})
        if mesh == SETTLED:
            self._settle(air.latency)
        meshes = {name: robot.mesh for name, robot in self.robots.items() if isinstance(robot.mesh, DelayMesh)}
        for each in meshes.values():
            each.link(meshes, self.air.cuts)
        if config.simulation.moving:
            self.time.soon(self._tell_target)

    @property
    def sent(self) -> int:
        """The number of app frames that all meshes have sent."""
        return sum(robot.sent for robot in self.robots.values())

    def switch_off(self, robot: str, seconds: float, *, falls: bool = True) -> None:
        """Switch a robot off: its mesh and its apps end at once, and with them what they knew, but for its votes and
        the stops. After `seconds` they start anew. Its body falls (or where it does not `falls`, as one that is still
        held, stays as it is) and stands up when it is on again, unless robots begin lying or a stop holds."""
        there = self.robots[robot]
        there.off_until = max(there.off_until, self.time.now + seconds)
        if not there.balancer.powered:
            return  # it stays off for longer
        begun = self._launches(robot)
        for app in tuple(there.apps):
            self._end(there, app)
        there.storage.forget()
        there.balancer.switch_off(falls=falls)
        self.air.switch_off(robot)
        self._kill_mesh(robot, seconds)
        self.time.at(self.time.now + seconds, self._switch_on, robot, begun)

    def kill_app(self, robot: str, app: str) -> None:
        """End an app's process at once; it is started again, and goes on from its snapshots. Raises `LocalError` where
        it does not run."""
        there = self._powered(robot)
        if app not in there.apps:
            raise LocalError(NOT_RUNNING)
        self._end(there, app)
        begun = [self._launched[robot, app]]
        self.time.at(self.time.now + RESTART_DELAY_S, self._start_again, there, begun)

    def kill_mesh(self, robot: str) -> None:
        """End a robot's mesh at once; it is started again. Raises `LocalError` where it does not run."""
        there = self._powered(robot)
        if isinstance(there.mesh, VirtualMesh) and not there.mesh.running:
            raise LocalError(NOT_RUNNING)
        self._kill_mesh(robot, RESTART_DELAY_S)
        self.time.at(self.time.now + RESTART_DELAY_S, self._start_again, there, [])

    def _powered(self, robot: str) -> VirtualRobot:
        """Return a robot that is on. Raises `LocalError` where it is switched off."""
        there = self.robots[robot]
        if not there.balancer.powered:
            raise LocalError(SWITCHED_OFF)
        return there

    def _kill_mesh(self, robot: str, seconds: float) -> None:
        """End a mesh. Where there are the delays of a mesh alone, messages stay away for `seconds`."""
        there = self.robots[robot]
        if isinstance(there.mesh, VirtualMesh):
            if there.mesh.running:  # else it was killed just before
                there.sent_before += there.mesh.sent
                there.mesh.kill()
        else:
            for peer in self._common.near[robot]:
                self.air.cut(robot, peer, seconds)

    @staticmethod
    def _end(there: VirtualRobot, app: str) -> None:
        """End an app as by kill -9: nothing is said any more."""
        host = there.apps.pop(app)
        there.buses.pop(app).close()
        there.speakers.pop(app).end()
        host.close()

    def _start_again(self, there: VirtualRobot, begun: list[Launch]) -> None:
        """Start what was killed, unless the robot was switched off meanwhile."""
        if not there.balancer.powered:
            return
        there.starts += 1
        if isinstance(there.mesh, VirtualMesh) and not there.mesh.running:
            there.meshes_bus = VirtualBus(there.router)
            there.mesh = VirtualMesh(
                self._common,
                there.name,
                there.time,
                self.air,
                there.meshes_bus,
                self.seed,
                incarnation=there.starts,
                stops=there.mesh.kept_stops,
            )
        for launch in begun:
            if launch.app.name not in there.apps:
                self._begin(there.name, launch)

    def _switch_on(self, robot: str, begun: list[Launch]) -> None:
        there = self.robots[robot]
        if self.time.now < there.off_until:
            # The apps of a robot that was to come meanwhile have been launched, and have not begun.
            self.time.at(there.off_until, self._switch_on, robot, self._launches(robot))
            return
        there.balancer.switch_on(stands=self._lying is None)
        self._start_again(there, begun)

    def _launches(self, robot: str) -> list[Launch]:
        return [launch for (name, _), launch in self._launched.items() if name == robot]

    def act(self, robot: str, act: SimulationAction) -> None:
        """Let a person do something to a robot. Raises `LocalError` where it is switched off."""
        self._powered(robot).balancer.act(act)

    def start_app(self, robot: str, launch: Launch, after: float = 0.0) -> None:
        """Start an app's host after so many s; with an automatic topology it begins when that links all robots."""
        self._launched[robot, launch.app.name] = launch
        if after:
            self.time.at(self.time.now + after, self._begin, robot, launch)
        else:
            self.time.soon(self._begin, robot, launch)

    def _begin(self, robot: str, launch: Launch) -> None:
        """Start an app on a robot, or look again later."""
        app, run, run_options, rows, observer, make_runner = launch
        config, epoch, there = self.config, topology.CONFIGURED, self.robots[robot]
        if not there.balancer.powered or app.name in there.apps:
            return  # the robot was switched off meanwhile, and starts its apps when it is on again
        if config.auto:
            assert isinstance(there.mesh, VirtualMesh)  # an automatic topology is found by meshes
            in_force = there.mesh.look(lambda overlays, now: overlays.topology(now))
            if topology.lacking(config, in_force, there.time.now):
                self.time.at(self.time.now + topology.ASK_EVERY, self._begin, robot, launch)
                return
            links = topology.of_edges(config, in_force.edges)
            config, epoch = links.config, links.epoch
        instance = app.make(config, robot, self.seed)
        bus = VirtualBus(there.router)
        runtime = VirtualRuntime(robot, there.time, bus)
        begin = app.name, run, epoch
        if begin not in self._begin_with:
            self._begin_with[begin] = topology.RunPlace.of(run, app.digest, run_options, config, epoch, 1)
        place = self._begin_with[begin]._replace(incarnation=there.starts)
        # Tickets of requests: others in each run, and after each start.
        tickets = f"{run & 0xFFFFFFFFFFFF:012x}" + (f"-{there.starts}" if there.starts > 1 else "")
        overlays = equip(instance.robot, bus, logging.getLogger(robot), partial(getattr, there.time, "now"), tickets)
        keep = self.records.get((robot, app.name))
        instance.robot.recording = RecordedValues(bus, robot, app.name, keep) if self.watched else keep
        speaker = let_speak(instance.robot, bus, None, *self.hearers.get((robot, app.name), ()))
        if metrics_of(type(instance)):
            instance.robot.truth = self.truth(robot, app.name, type(instance))
        host: LockstepHost | EventHost
        if isinstance(instance, EventApp):
            events = (make_runner or EventRunner)(instance, app.source)
            assert isinstance(events, EventRunner)
            host = EventHost(
                *(runtime, app.name, events, place, self.config, there.storage, observer), links_change=config.auto
            )
        else:
            assert isinstance(instance, SyncApp)
            overlays.collect()
            measurements = self._measurements(runtime, rows, run_options.last) if instance.measured else None
            runner = (make_runner or partial(Runner, tolerance=run_options.tolerance))(instance, app.source)
            assert isinstance(runner, Runner)
            parts = [Part("", runner, measurements)]
            host = LockstepHost(
                *(runtime, app.name, parts, place, there.storage, observer),
                links_change=run_options.drop,  # else nobody asks which links are in force
            )
        there.apps[app.name], there.buses[app.name], there.speakers[app.name] = host, bus, speaker
        host.start()

    def truth(self, robot: str, app: str, kind: type[BaseApp]) -> Callable[[], RobotTruth]:
        """Return the function that gives the truth for an app of this class on a robot."""
        if app not in self._told:
            self._told[app] = told(self.config, app, kind)
        simulation, known = self.config.simulation, self._told[app]

        def look() -> RobotTruth:
            body = self.robots[robot].balancer.look()
            target = simulation.target_after(self.time.now - self.modules.moves_from)
            return RobotTruth(body.x, body.y, body.heading, target, known)

        return look

    def _measurements(self, runtime: VirtualRuntime, rows: Rows | None, last: int | None) -> Measurements:
        if rows is None:
            return source_of(runtime, self.config, last)
        bus = VirtualBus(self.robots[runtime.robot].router)
        bus.serve(key(runtime.robot, "dwm", "measurement"), partial(answer_row, rows))
        return Replayed(runtime, last)

    def _tell_target(self) -> None:
        """Publish the place of a moving target, for recordings."""
        now = self.time.now
        self.time.at(now + TARGET_PERIOD_S, self._tell_target)
        place = Target(now, *self.config.simulation.target_after(now - self.modules.moves_from))
        for name, robot in self.robots.items():
            robot.dwm.bus.publish(key(name, "sim", "target"), place)

    def _settle(self, latency: float) -> None:
        times = round(max(latency * 1e4, 1.0))
        links = {name: dict.fromkeys(near, times) for name, near in self._common.near.items()}
        known = {name: AdvertisedLinks(FIRST_INCARNATION, Advertisement(near), 0.0) for name, near in links.items()}
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
        balancer = VirtualBalancer(self.config, name, self._body, time, bus, self.seed, self._scene_record)
        if self._lying is not None:
            balancer.body.lay(self._lying, time.now)
        dwm = VirtualDwm(
            self.config, self._common.robots[name], self.modules, balancer, time, VirtualBus(router), self.seed
        )
        storage = MemoryStorage(snapshots=self._processes_end)
        return VirtualRobot(name, router, mesh, meshes_bus, balancer, dwm, time, storage)
