"""The neighbours of one robot, and theirs, in one process: their meshes' real cores, threads and links, with the
lockstep and the app behind each, but no bus and nothing else of a robot. See `bench.one_sim`.
"""

import os
import random
import threading
import time
from collections import Counter
from collections.abc import Sequence
from functools import partial

from bench import one_sim, socket_mesh
from services.apps import loader
from services.apps.host import schema_of
from services.apps.runner import Runner as App
from services.mesh.__main__ import local_of
from services.mesh.core.events import Received
from services.mesh.core.node import MeshNode
from services.mesh.core.overlays.robot_overlays import RobotOverlays
from services.mesh.core.relay import KeyRelay
from services.mesh.core.routing.topology import Ground
from services.mesh.core.routing.wanted_links import InitialLinks
from services.mesh.core.wire.frames import NONCE_SIZE
from services.mesh.network import Network
from services.mesh.runner import MeshRunner
from swarm import clock
from swarm.app.sync_app import SyncApp
from swarm.config import Config, load
from swarm.core.lockstep import Channel, Compute, Lockstep, Send
from swarm.core.lockstep_actions import address_of
from swarm.errors import FrameError
from swarm.messages.keys import key
from swarm.process import log, service
from swarm.process.edges import die_with_parent
from swarm.process.paths import runtime_dir

APP = "consensus"
LOOK_S = 0.05
"""s between two looks at the locksteps' timers; what is lost at the start is asked for by them."""


class Peer:
    """One neighbour."""

    def __init__(self, config: Config, robot: str, run: int) -> None:
        """`config`: its own."""
        local, relay, counters = (
            local_of(config, robot),
            KeyRelay(robot, (), config.relay, config.names),
            Counter[str](),
        )
        overlays = RobotOverlays(
            robot,
            config.names,
            incarnation=time.time_ns() // 1000,
            random=random.random,
            counters=counters,
            start=InitialLinks(Ground(config.names, config.edges, auto=config.auto), local.dials),
            admits_flood=relay.admits_flood,
            admits_unicast=relay.admits_unicast,
        )
        nonce = partial(os.urandom, NONCE_SIZE)
        network = Network(config, local, runtime_dir())
        self._mesh = MeshRunner(
            MeshNode(local, relay, overlays, random=random.random, nonce=nonce, counters=counters),
            listeners=network.listeners,
            dial=network.dial,
            deliver=self._take,
            changed=lambda: None,
            keep=lambda: None,
        )
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
        self._mesh.start()
        with self._lock:
            self._lockstep.start(self._app.start(None)[0], clock.now())
            self._began = True
            self._carry_out()

    def look(self) -> None:
        """Do what is due."""
        with self._lock:
            self._lockstep.handle_timer(clock.now())
            self._carry_out()

    def _take(self, messages: Sequence[Received]) -> None:
        """On the mesh's thread."""
        with self._lock:
            for message in messages if self._began else ():
                if (address := address_of(message.key)) is None:
                    continue
                sender, _, text, _, around = address
                try:
                    self._lockstep.receive(sender, Channel.parse(text), message.payload, clock.now(), around=around)
                except FrameError:  # what robots say about the members
                    continue
            self._carry_out()

    def _carry_out(self) -> None:
        while actions := self._lockstep.actions():
            for action in actions:
                if isinstance(action, Compute):
                    own, private = self._app.step(action.k, action.own, action.values, None)
                    self._lockstep.computed(own, private, clock.now())
                elif isinstance(action, Send):
                    self._mesh.publish(None, action.key(self._key), action.data)


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
