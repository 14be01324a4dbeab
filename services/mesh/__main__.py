"""The mesh service: carries chosen keys between this robot's bus and its neighbours'."""

import logging
import os
import random
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial

from services.mesh import topology_file
from services.mesh.bus_interface import BusInterface
from services.mesh.core.events import Received
from services.mesh.core.link.calls import Local, can_link, dials
from services.mesh.core.node import MeshNode
from services.mesh.core.overlays.robot_overlays import RobotOverlays
from services.mesh.core.relay import KeyRelay
from services.mesh.core.routing.topology import Ground
from services.mesh.core.routing.wanted_links import InitialLinks
from services.mesh.core.wire.frames import BULK, NONCE_SIZE
from services.mesh.links.pipe import describe
from services.mesh.network import Network
from services.mesh.runner import MeshRunner
from services.mesh.view_sender import ViewSender
from swarm import clock
from swarm.config import Config
from swarm.config.keyfile import read_keys
from swarm.messages import Clock, Links
from swarm.messages.keys import key
from swarm.process import service
from swarm.process.paths import state_dir
from swarm.process.service import Service

_REPORT_PERIOD = 1.0
"""s between two publications of `mesh/links` and `mesh/clock` when nothing changes."""

_FRAMES = "swarm/*/app/*/sync/**"
"""All frames of locksteps: most of what comes in, and hardly ever does anybody listen to them on the bus."""


def local_of(config: Config, me: str) -> Local:
    """What a robot's links have in common, by its configuration."""
    own, settings = config.robot(me), config.mesh
    return Local(
        robot=me,
        network=config.network,
        incarnation=int.from_bytes(os.urandom(8), "little"),
        insecure=settings.insecure,
        keys=read_keys(settings.key_file) if settings.key_file is not None and len(config.robots) > 1 else {},
        dials={peer.name: dials(own, peer) for peer in config.robots if peer is not own and can_link(own, peer)},
        robots=frozenset(config.names),
        heartbeat=settings.heartbeat,
        suspect=settings.suspect,
        dead=settings.dead,
    )


_log = logging.getLogger("mesh")


class _Mesh(MeshRunner):
    """A runner that publishes its links and keeps the topology; the newest state is always the last one."""

    def __init__(self, node: MeshNode, network: Network, service: Service, heard: Callable[[str, bytes], None]) -> None:
        """`heard(key, payload)` gets what came in, besides the bus."""
        super().__init__(
            node,
            listeners=network.listeners,
            dial=network.dial,
            deliver=self._to_bus,
            changed=self.report,
            keep=self._keep_topology,
        )
        self._service = service
        self._bus = service.bus
        self._heard = heard
        self._links_key = key(service.robot, "mesh", "links")
        self._clock_key = key(service.robot, "mesh", "clock")
        self._topology_key = key(service.robot, "mesh", "topology")
        self._reporting = threading.Lock()
        self._keeping = threading.Lock()

    def report(self) -> None:
        """Publish `mesh/links`, `mesh/clock` and `mesh/topology`."""
        with self._reporting:
            self._bus.publish(self._topology_key, self.look(lambda each, now: each.topology(now)))
            self._bus.publish(self._links_key, Links(clock.now(), self.links(), self.clashes()))
            self._bus.publish(self._clock_key, Clock(*self.clock()))

    def _keep_topology(self) -> None:
        try:
            with self._keeping:
                topology_file.save(state_dir(), self.look(lambda each, now: each.topology_file()))
        except OSError as error:
            self._service.degraded(f"the topology cannot be kept through a restart: {state_dir()}: {describe(error)}")

    def _to_bus(self, messages: Sequence[Received]) -> None:
        for each in messages:
            self._heard(each.key, each.payload)
            self._bus.publish(each.key, each.payload, urgent=each.priority < BULK)


def main() -> None:
    """Run until SIGTERM."""
    with Service("mesh", direct=True) as this:
        local = local_of(this.config, this.robot)
        ground = Ground(this.config.names, this.config.edges, auto=this.config.auto)
        start = InitialLinks(ground, local.dials, topology_file.load(state_dir(), ground))
        relay = KeyRelay(this.robot, (), this.config.relay, this.config.names)
        overlays = RobotOverlays(
            this.robot,
            this.config.names,
            incarnation=time.time_ns() // 1000,
            random=random.random,
            counters=this.counters,
            metric=this.config.mesh.metric,
            process=local.process,
            start=start,
            admits_flood=relay.admits_flood,
            admits_unicast=relay.admits_unicast,
        )
        nonce = partial(os.urandom, NONCE_SIZE)
        node = MeshNode(local, relay, overlays, random=random.random, nonce=nonce, counters=this.counters)
        network = Network(this.config, local, this.runtime)
        view_sender = ViewSender(this.robot, len(this.config.names), this.runtime)
        mesh = _Mesh(node, network, this, view_sender.heard)
        BusInterface(this.bus, this.robot, mesh, relay.subscriptions, this.counters, partial(this.log.warning, "%s"))
        view_sender.begin(this.bus, mesh)
        mesh.start()
        this.ready()
        while not this.stopping.wait(_REPORT_PERIOD):
            mesh.report()
            view_sender.step()
            if mesh.turned():
                this.watchdog()
        view_sender.close()
        mesh.stop()
        network.close()


if __name__ == "__main__":
    service.run(main)
