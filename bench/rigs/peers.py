"""The neighbours of one robot, and theirs, in one process: their meshes' real cores, threads and links, with the
lockstep and the app behind each, but no bus and nothing else of a robot. See `bench.rigs.one_sim`.
"""

import contextlib
import logging
import os
import threading
import time
from collections import Counter
from typing import cast

from bench.rigs import one_sim, socket_mesh
from services.apps import loader
from services.apps.host.host import schema_of
from services.apps.runner import Runner as App
from services.mesh.__main__ import CHANCE, incarnation, local_by_file
from services.mesh.core.routing.wanted_links import InitialLinks
from services.mesh.mesh import Mesh, ground_of
from services.mesh.network import Network
from services.mesh.sockets import Sockets
from swarm import clock
from swarm.app.sync_app import SyncApp
from swarm.bus.protocol import BusLike
from swarm.config import Config, load
from swarm.core.lockstep.actions import Compute, Send, address_of, key_of
from swarm.core.lockstep.frames import Channel
from swarm.core.lockstep.lockstep import Lockstep
from swarm.errors import FrameError
from swarm.messages.keys import key
from swarm.process import log, service
from swarm.process.edges import die_with_parent
from swarm.process.locked_runtime import LockedRuntime
from swarm.process.paths import runtime_dir

APP = "consensus"
LOOK_S = 0.05
"""s between two looks at the locksteps' timers; what is lost at the start is asked for by them."""


class Peer:
    """One neighbour."""

    def __init__(self, config: Config, robot: str, run: int) -> None:
        """`config`: its own."""
        local = local_by_file(config, robot)
        network = Network(config, local, runtime_dir())
        # Where a mesh has a bus, this robot's app is called. Nobody hears what the mesh tells of itself.
        runtime = LockedRuntime(cast(BusLike, self), Counter(), logging.getLogger("mesh"))
        self._sockets = Sockets(runtime, network.listeners, network.dial)
        self._mesh = Mesh(
            config,
            local,
            InitialLinks(ground_of(config), local.dials),
            CHANCE,
            incarnation(),
            runtime,
            self._sockets,
            keep=lambda data: None,
            keep_stops=lambda data: None,
        )
        self._relay = runtime.entry(self._mesh.publish)
        app = loader.load(APP)
        instance = app.make(config, robot)
        assert isinstance(instance, SyncApp)
        self._app = App(instance, app.source)
        self._channel = Channel(run, 0, 1, schema_of(self._app, "", app.digest))
        self._lockstep = Lockstep(robot, config.neighbours(robot), self._channel, self._app.size)
        self._key = f"{key(robot, 'app', APP, 'sync')}/{self._channel.text}"
        self._lock = threading.RLock()
        self._began = False

    def start(self) -> None:
        """Begin at iteration 0."""
        self._sockets.start(self._mesh)
        with self._lock:
            self._lockstep.start(self._app.start(None)[0], clock.now())
            self._began = True
            self._carry_out()

    def look(self) -> None:
        """Do what is due."""
        with self._lock:
            self._lockstep.handle_timer(clock.now())
            self._carry_out()

    def wanted(self, key: str) -> bool:
        """No reports."""
        return False

    def publish(self, key: str, payload: bytes, *, urgent: bool) -> None:
        """Take a message, on the mesh's thread."""
        if (address := address_of(key)) is None:
            return
        sender, _, text, _, around = address
        with self._lock:
            if self._began:
                # What robots say about the members is no frame of a lockstep.
                with contextlib.suppress(FrameError):
                    self._lockstep.receive(sender, Channel.parse(text), payload, clock.now(), around=around)
            self._carry_out()

    def _carry_out(self) -> None:
        while actions := self._lockstep.actions():
            for action in actions:
                if isinstance(action, Compute):
                    own, private = self._app.step(action.k, action.own, action.values, None)
                    self._lockstep.computed(own, private, clock.now())
                elif isinstance(action, Send):
                    self._relay(None, key_of(self._key, action.to, around=action.around), action.data)


def main() -> None:
    """All robots but one, until killed."""
    die_with_parent()
    log.setup("peers")
    config, run = load(), int(os.environ["SWARM_RUN"], 16)
    names = [name for name in config.names if name != one_sim.ROBOT]
    peers = [Peer(socket_mesh.of_robot(config, name), name, run) for name in names]
    for peer in peers:
        peer.start()
    while True:
        time.sleep(LOOK_S)
        for peer in peers:
            peer.look()


if __name__ == "__main__":
    service.run(main)
