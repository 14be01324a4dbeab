"""UWB under virtual time: simulated modules that mismeasure as `sim.core.uwb` has it, and for each robot what
`services.dwm` makes of them: calibration, filters, Kalman filter, at 10 Hz.

A robot's module measures as long as somebody hears what comes of it: a filter costs more than all of a mesh.
"""

import logging
import math
import random
from collections import Counter
from typing import NamedTuple

from services.dwm.core.module.tlv import NOWHERE, Location, Position
from services.dwm.localizer import Localizer
from sim.core.module_line import module_address
from sim.core.uwb import PERIOD, Module, Tag, error_model
from sim.virtual.bus import VirtualBus
from sim.virtual.events import Time
from sim.virtual.periodic_publisher import PeriodicPublisher
from sim.virtual.robot.balancer import VirtualBalancer
from swarm.config import Config, RobotConfig
from swarm.messages.keys import key

_SILENT = logging.getLogger("virtual.dwm")
"""Logger of the dwm services, whose lines nobody would read here."""
_SILENT.disabled = True


class _Standing(NamedTuple):
    """A module that stands by itself."""

    address: str
    place: tuple[float, float, float]
    known: Position


class ModuleField:
    """All modules of a world: the anchors, the target, and those of robots that are anchors."""

    def __init__(self, config: Config) -> None:
        self._simulation = config.simulation
        self.height = config.dwm.height
        """Height of the robots' antennas, and of a target that is no anchor, m."""
        self._target = target = config.dwm.target
        self.moves_from = math.inf
        """The time at which the target begins to move, if it does."""
        self._standing = []
        for anchor in config.anchors:
            at = (anchor.x, anchor.y)
            if anchor.address == target:  # the simulation may have moved it
                at = config.simulation.target
            self._standing.append(
                _Standing(anchor.address, (*at, anchor.z), Position(anchor.x, anchor.y, anchor.z, 100))
            )
        if target is not None and all(module.address != target for module in self._standing):
            self._standing.append(_Standing(target, (*config.simulation.target, self.height), NOWHERE))
        self._carried: dict[str, tuple[str, VirtualBalancer]] = {}

    def move(self, address: str, x: float, y: float) -> None:
        """Put a module that stands by itself somewhere else."""
        self._standing = [
            each._replace(place=(x, y, each.place[2])) if each.address == address else each for each in self._standing
        ]

    def carry(self, robot: str, address: str, balancer: VirtualBalancer) -> None:
        """Add a robot whose module is an anchor."""
        self._carried[robot] = (address, balancer)

    def around(self, robot: str, now: float) -> list[Module]:
        """Return the modules to which a robot's module may range."""
        if self._simulation.moving and self._target is not None:
            self.move(self._target, *self._simulation.target_after(now - self.moves_from))
        modules = [Module(each.address, *each.place, each.known) for each in self._standing]
        for name, (address, balancer) in self._carried.items():
            if name != robot:
                body = balancer.look()
                modules.append(Module(address, body.x, body.y, self.height, NOWHERE))
        return modules


class VirtualDwm:
    """One robot's module and its dwm service."""

    def __init__(
        self,
        config: Config,
        known: RobotConfig,
        field: ModuleField,
        balancer: VirtualBalancer,
        time: Time,
        bus: VirtualBus,
        seed: int,
    ) -> None:
        robot = known.name
        self.config, self.robot, self.bus = config, robot, bus
        self.counters: Counter[str] = Counter()
        self.log = _SILENT
        self._field = field
        self._balancer = balancer
        self._time = time
        if known.uwb_role == "anchor":
            field.carry(robot, known.uwb or module_address(config.names.index(robot)), balancer)
        self._is_tag = known.uwb_role == "tag"
        # The generator of the real simulation's module: a robot that stands gets the very same errors.
        self._tag = Tag(random.Random(f"{seed} {robot} uwb"), error_model(config.simulation.range_noise))
        self._latency = config.dwm.latency
        self._keys = key(robot, "dwm", "ranges"), key(robot, "dwm", "pose")
        self._localizer: Localizer | None = None
        phase = random.Random(f"{seed} {robot} latency").random()
        PeriodicPublisher(time, bus, self._keys, PERIOD, time.now + PERIOD * phase, self._measure)

    def _measure(self) -> None:
        now = self._time.now
        if not self._balancer.powered:
            return
        if self._localizer is None:
            self._localizer = Localizer(self, now)
        body = self._balancer.look()
        location = (
            self._tag.measure(self._field.around(self.robot, now), body.x, body.y, body.heading, self._field.height)
            if self._is_tag
            else Location(NOWHERE, ())
        )
        self._time.at(now + self._latency, self._report, location)

    def _report(self, location: Location) -> None:
        assert self._localizer is not None
        self._localizer.report(location, self._time.now)
