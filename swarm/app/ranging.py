"""Distances to other robots for apps and services: `Ranging(bus, robot).distance("r1")`.

A DWM1001 tag ranges to anchors alone. So a distance between two robots is there where the module of one of them is an
anchor (`uwb_role` in swarm.toml), and `uwb` says whose it is. The anchor's robot measures nothing itself: it knows the
distance where the mesh relays `swarm/{self}/dwm/ranges` to it.
"""

import logging
import threading

from swarm import clock
from swarm.bus.protocol import BusLike, Now
from swarm.core.ranging import RangeTable
from swarm.errors import PayloadError
from swarm.messages import Range, Ranges
from swarm.messages.codec import decode
from swarm.messages.keys import key, parse

_log = logging.getLogger("ranging")


class Ranging:
    """Reads `dwm/ranges` of all robots from one robot's bus, from when somebody first asks: most apps never do, and ten
    messages a second cost each of them more than its own work."""

    def __init__(self, bus: BusLike, robot: str, now: Now = clock.now) -> None:
        """`now` is the robot's monotonic clock."""
        self._now = now
        self._table = RangeTable(robot)
        self._lock = threading.Lock()
        self._bus = bus
        self.listening = False
        """Whether the app has asked for ranges."""

    @property
    def ranges(self) -> tuple[Range, ...]:
        """This robot's newest ranges, to anchors and robots; none older than a second."""
        self._listen()
        with self._lock:
            return self._table.ranges(self._now())

    def distance(self, robot: str) -> float | None:
        """Return the distance to another robot, m; None where neither has measured it within the last second."""
        self._listen()
        with self._lock:
            return self._table.distance(robot, self._now())

    def _listen(self) -> None:
        if not self.listening:
            self.listening = True
            self._bus.subscribe(key("*", "dwm", "ranges"), self._receive)

    def _receive(self, name: str, payload: bytes) -> None:
        """Runs on Zenoh's thread."""
        try:
            message = decode(Ranges, payload, name)
        except PayloadError as error:
            _log.debug("%s", error)
            return
        with self._lock:
            self._table.take(parse(name).robot, message, self._now())
