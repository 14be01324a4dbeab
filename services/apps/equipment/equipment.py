"""The equipment of an app's robot where it runs on a bus: clients of the other services."""

import logging

from swarm import clock
from swarm.app.devices import Devices
from swarm.app.mesh_clock import MeshClock
from swarm.app.overlays import Overlays
from swarm.app.ranging import Ranging
from swarm.app.robot import Robot
from swarm.bus.protocol import BusLike, Now


def equip(
    robot: Robot, bus: BusLike, log: logging.Logger, now: Now = clock.now, tickets: str | None = None
) -> Overlays:
    """Give an app's robot the clients of the other services. `tickets`: what those of its requests begin with; random
    where it is not named. Returns the client of the overlays."""
    robot.log = log
    robot.time = now
    robot.bus = bus
    robot.overlays = Overlays(bus, robot.name, robot.app, now=now, prefix=tickets)
    robot.mesh_clock = MeshClock(bus, robot.name, now)
    robot.ranging = Ranging(bus, robot.name, now)
    robot.devices = Devices(bus, robot.name, now)
    return robot.overlays
