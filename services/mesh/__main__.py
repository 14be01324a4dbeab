"""The mesh service: carries chosen keys between this robot's bus and its neighbours'."""

import os
import random
import time
from functools import partial

from services.mesh import stops_file, topology_file
from services.mesh.bus_interface import BusInterface
from services.mesh.core.link.calls import Local
from services.mesh.core.routing.physical_links import calls_of
from services.mesh.core.routing.wanted_links import InitialLinks
from services.mesh.core.wire.frames import NONCE_SIZE
from services.mesh.file_writer import FileWriter
from services.mesh.mesh import Chance, Mesh, dials_of, ground_of, local_of
from services.mesh.network import Network
from services.mesh.sockets import Sockets
from services.mesh.view_sender import ViewSender
from swarm.bus.session_watch import SessionWatch
from swarm.config import Config
from swarm.config.keyfile import read_keys
from swarm.process import service
from swarm.process.locked_runtime import LockedRuntime
from swarm.process.paths import state_dir

_LOOK_S = 1.0
"""Seconds between two checks that the reading thread and the bus are alive, and which viewers watch through this
robot."""
_UNANSWERED = 20
"""Questions to the router in a row without an answer after which the mesh ends. A router that hangs itself is replaced
by systemd sooner, and the mesh's links outlive that."""

CHANCE = Chance(random.random, partial(os.urandom, NONCE_SIZE))


def local_by_file(config: Config, me: str) -> Local:
    """Return what the links of this robot's process have in common; the keys are read from their file."""
    settings = config.mesh
    return local_of(
        config,
        me,
        frozenset(config.names),
        dials_of(config.robot(me), config.robots, calls_of(config)),
        incarnation=int.from_bytes(os.urandom(8), "little"),
        insecure=settings.insecure,
        keys=read_keys(settings.key_file) if settings.key_file is not None and len(config.robots) > 1 else {},
    )


def incarnation() -> int:
    """Return the number of a mesh's floods, which is higher at each start."""
    return time.time_ns() // 1000


def main() -> None:
    with service.Service("mesh", direct=True) as this:
        local = local_by_file(this.config, this.robot)
        ground = ground_of(this.config)
        start = InitialLinks(ground, local.dials, topology_file.load(state_dir(), ground), local.pages)
        network = Network(this.config, local, this.runtime)
        runtime = LockedRuntime(this.bus, this.counters, this.log)
        sockets = Sockets(runtime, network.listeners, network.dial)
        start_number = incarnation()
        view_sender = ViewSender(this.robot, len(this.config.names), this.runtime)
        stops = FileWriter("stops", state_dir() / stops_file.NAME)
        topology = FileWriter("the topology", state_dir() / topology_file.NAME)
        mesh = Mesh(
            this.config,
            local,
            start,
            CHANCE,
            start_number,
            runtime,
            sockets,
            keep=topology.keep,
            keep_stops=stops.keep,
            stops=stops_file.load(state_dir(), this.robot, start_number),
            heard=view_sender.heard,
            role_of=network.roles.of,
        )
        BusInterface(runtime, mesh)
        view_sender.begin(this.bus, runtime.entry(mesh.ask))
        sockets.start(mesh)
        this.ready()
        session = SessionWatch(this.bus, _UNANSWERED)
        while not this.stopping.wait(_LOOK_S):
            session.look()
            if problem := stops.problem or topology.problem:
                this.degraded(problem)
            else:
                this.ready()
            view_sender.step()
            network.follow(local.dials)
            network.roles.look()
            if sockets.turned():
                this.watchdog()
        view_sender.close()
        sockets.stop()
        network.close()
        for file in (stops, topology):
            file.close()


if __name__ == "__main__":
    service.run(
        main, "Run the mesh of this robot, which carries chosen keys between its bus and the buses of other robots."
    )
