"""The mesh service of one robot under virtual time: `services.mesh.mesh` over the air of `sim.virtual.radio.air`."""

import random
from functools import partial

from services.mesh.bus_interface import BusInterface
from services.mesh.core.overlays.stop import from_file
from services.mesh.core.routing.physical_links import calls_of, is_bluetooth
from services.mesh.core.routing.wanted_links import InitialLinks
from services.mesh.core.wire.frames import NONCE_SIZE
from services.mesh.mesh import Chance, Mesh, dials_of, ground_of, local_of
from sim.virtual.bus import VirtualBus
from sim.virtual.events import Time
from sim.virtual.radio.air import Medium, Station
from sim.virtual.runtime import VirtualRuntime
from swarm.config import Config

FIRST_INCARNATION = 1
"""First incarnation number of each robot's floods."""


class Common:
    """The common part of all robots' meshes; made once, since it grows with the swarm."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self._calls = calls_of(config)
        self.robots = {robot.name: robot for robot in config.robots}
        self.names = frozenset(self.robots)
        self.ground = ground_of(config)
        near: dict[str, set[str]] = {name: set() for name in config.names}
        for a, b in config.edges:
            near[a].add(b)
            near[b].add(a)
        self.near = {name: tuple(sorted(others)) for name, others in near.items()}

    def dials(self, robot: str) -> dict[str, bool]:
        """Return with which robots a robot may be linked, and whether it calls them. Of a fixed topology these are
        its neighbours alone: the tables of a thousand robots would hold a million unused entries."""
        own = self.robots[robot]
        anybody = self.config.auto or self.ground.carried
        others = self.names - {robot} if anybody else self.near[robot]
        peers = (self.robots[name] for name in sorted(others))
        return dials_of(own, peers, self._calls)


class VirtualMesh(Mesh):
    """One robot's mesh."""

    def __init__(
        self,
        common: Common,
        robot: str,
        time: Time,
        air: Medium,
        bus: VirtualBus,
        seed: object,
        incarnation: int = FIRST_INCARNATION,
        stops: bytes = b"",
    ) -> None:
        """`incarnation` goes up with every start of the robot. `stops`: the kept stops of the process before it."""
        self.kept_stops = stops
        # The text's hash is not Python's own, which differs from process to process.
        numbers = random.Random(f"{seed} {robot} mesh" + (f" {incarnation}" if incarnation > 1 else ""))
        dials = common.dials(robot)
        surroundings = VirtualRuntime(robot, time, bus)
        self._station = Station(robot, time, air)
        super().__init__(
            common.config,
            local_of(
                common.config,
                robot,
                common.names,
                dials,
                numbers.getrandbits(64),
                insecure=True,
                keys={},
            ),
            InitialLinks(common.ground, dials, pages=is_bluetooth(common.config)),
            Chance(numbers.random, partial(numbers.randbytes, NONCE_SIZE)),
            incarnation,
            surroundings,
            self._station,
            keep=lambda data: None,
            keep_stops=self._keep_in_memory,
            stops=from_file(stops) if stops else None,
            wanted=bus.wanted,
        )
        BusInterface(surroundings, self)
        self._station.start(self)

    @property
    def sent(self) -> int:
        """Messages of apps that left, counted once for each neighbour."""
        return self._surroundings.counters["sent_sync"]

    def _keep_in_memory(self, data: bytes) -> None:
        self.kept_stops = data

    def kill(self) -> None:
        """End as by kill -9: the connections close, nothing is said."""
        self._station.end()
        assert isinstance(self._surroundings.bus, VirtualBus)
        self._surroundings.bus.close()
