"""Tells those who watch the swarm through another robot what this one's bus says; see `core.overlays.viewing`.

What is told is heard by a session of its own, which is there only while somebody watches: else this costs nothing.
"""

import threading
from collections.abc import Callable
from pathlib import Path

from services.mesh.core.overlays.robot_overlays import RobotOverlays
from services.mesh.core.overlays.viewing import KEYS, Viewing
from services.mesh.core.wire.frames import BULK
from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.errors import PayloadError
from swarm.messages import Watch
from swarm.messages.codec import decode
from swarm.messages.keys import key, parse

_ASK_S = 2.0
"""Seconds that services may take to report their state."""


class ViewSender:
    """The sender of one mesh process' views."""

    def __init__(self, robot: str, robots: int, runtime: Path) -> None:
        """`robots`: how many the swarm has; `runtime` is where this one's bus is."""
        self._robot = robot
        self._runtime = runtime
        self._viewing = Viewing(robot, robots)
        self._lock = threading.Lock()
        """The lock that protects the viewing, which threads of bus and mesh use."""
        self._ask: Callable[[Callable[[RobotOverlays, float], object]], None]
        self._watch_key, self._view_key = key(robot, "mesh", "watch"), key(robot, "mesh", "view")
        self._listening: Bus | None = None

    def begin(self, bus: Bus, ask: Callable[[Callable[[RobotOverlays, float], object]], None]) -> None:
        """Hear who watches through this robot; `ask` is the mesh's, for any thread."""
        self._ask = ask
        bus.subscribe(key(self._robot, "mesh", "set", "watch"), self._asked_here)

    def heard(self, key: str, payload: bytes) -> None:
        """Take a message of another robot."""
        if not key.endswith("/mesh/watch"):
            return
        try:
            watch = decode(Watch, payload, key)
        except PayloadError:
            return
        with self._lock:
            self._viewing.asked(watch, parse(key).robot, clock.now())

    def step(self) -> None:
        """Begin or cease to listen, and send what is to be sent. It is called once a second."""
        now = clock.now()
        with self._lock:
            active = self._viewing.active(now)
        if not active:
            self.close()
            return
        if self._listening is None:
            self._listening = self._listen()
            return
        with self._lock:
            due = self._viewing.due(now)
        if due is not None:
            origins, view = due
            for origin in origins:
                self._send(origin, view)

    def close(self) -> None:
        if self._listening is not None:
            self._listening.close()
            self._listening = None

    def _asked_here(self, key: str, payload: bytes) -> None:
        try:
            decode(Watch, payload, key)
        except PayloadError:
            return
        with self._lock:
            ask = self._viewing.ask(clock.now())
        if ask:
            self._ask(lambda each, now: each.flood(self._watch_key, payload, BULK, now, latest=False))

    def _send(self, origin: str, view: bytes) -> None:
        self._ask(lambda each, now: each.send(origin, self._view_key, view, BULK, now, latest=True))

    def _listen(self) -> Bus:
        bus = Bus.of(self._runtime)
        bus.subscribe([key(self._robot, *topic.split("/")) for topic in KEYS], self._take)
        bus.watch(key(self._robot, "**", "alive"), self._alive)

        def ask(connected: bool) -> None:
            for each in ("*/status", "app/*/status") if connected else ():
                bus.ask(key(self._robot, *each.split("/")), self._take, timeout_s=_ASK_S)

        bus.on_change(ask)
        return bus

    def _take(self, key: str, payload: bytes) -> None:
        with self._lock:
            self._viewing.take(key, payload)

    def _alive(self, key: str, there: bool) -> None:
        with self._lock:
            self._viewing.alive(key, there)
