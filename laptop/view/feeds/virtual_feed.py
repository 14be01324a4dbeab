"""A run under virtual time that is watched: as fast as the page wishes it, and what it shows.

The simulation runs in a thread of its own and meets the page's server at the picture alone, some times a second.
"""

import math
import threading
from collections.abc import Mapping

from laptop.view.feeds.feed import RobotBus
from laptop.view.feeds.picture import Picture
from sim.scenario.quantities import FASTEST, SLOWEST
from sim.virtual.bus import VirtualBus
from sim.virtual.world import VirtualWorld
from swarm import clock
from swarm.config.types import Config
from swarm.messages.keys import parse

TOPICS = (
    "sim/truth", "sim/target", "sim/leds", "balancer/state", "balancer/fault", "mesh/links", "mesh/clock",
    "mesh/stopped", "mesh/topology", "app/*/state", "app/*/progress", "app/*/*/state", "app/*/*/progress",
    "app/*/parameters", "app/*/out/*", "app/*/record/*",
)  # fmt: skip
"""Topics of a robot, below its name."""
ESTIMATED = 12
"""The most robots whose estimated places are shown: the filters of `dwm` take more time than everything else."""

FRAMES = ("app/*/sync/*", "app/*/sync/*/*", "app/*/latest/*")
CROWD = 50
"""The number of robots from which on messages between them are not counted, because nobody could see them."""

TICK_S = 0.02
"""Seconds of virtual time between two looks at the real one."""
TELL_S, TELL_CROWD_S = 0.04, 0.1
"""Seconds of real time between two handovers to the picture."""
BEHIND_S = 0.25
"""Seconds of real time that a late run catches up at most."""
MEASURE_S = 1.0
LAST_S = 0.2
"""Seconds of virtual time until all robots have reported the end of the run."""


class VirtualFeed:
    """Watches a world until closed."""

    kind = "virtual"

    def __init__(self, world: VirtualWorld, config: Config, speed: float) -> None:
        """`speed`: seconds of virtual time in a second; infinity: as fast as the simulation computes."""
        self.picture = Picture()
        self.lock = threading.Lock()
        """The lock that protects the picture."""
        self.config: Config | None = config
        self.live = True
        """Whether the run is still going on."""
        self.buses: Mapping[str, RobotBus] = {}
        self._time = world.time
        self._now = 0.0
        self._speed = speed
        self._paused = False
        self._actual = 0.0
        self._turn = threading.Condition()
        """The condition that protects speed and pause. It is notified when they change."""
        self._closing = False
        self._newest: dict[tuple[str, str], bytes] = {}
        self._hops: dict[tuple[str, str], int] = {}
        self._tell_every = TELL_S if len(config.names) < CROWD else TELL_CROWD_S
        self._told_at = self._measured_at = -math.inf
        self._anchor = self._measured = (0.0, 0.0)
        """A virtual time and the real time at which it was reached."""
        world.watched = True
        for name, robot in world.robots.items():
            self._join(name, VirtualBus(robot.router), len(config.names))
        self._begin_again()
        world.time.soon(self._tick)

    def now(self) -> float:
        """Return the virtual time, s."""
        return self._now

    def check_control(self) -> None:
        """Do nothing: the page of a virtual run has no actions that could be refused."""

    def pace(self) -> dict[str, object]:
        """Return the speed that the page wishes (None: as fast as the simulation computes), and the actual speed."""
        wished = self._speed if math.isfinite(self._speed) else None
        return {"speed": wished, "actual": round(self._actual, 3), "paused": self._paused}

    def set_pace(self, speed: float | None, paused: bool) -> None:
        """Set another speed (None: as fast as the simulation computes), or pause. Raises `ValueError` for a speed that
        cannot be."""
        if speed is not None and not SLOWEST <= speed <= FASTEST:
            raise ValueError(f"speed {speed:g}: expected {SLOWEST:g} to {FASTEST:g}")
        with self._turn:
            self._speed, self._paused = math.inf if speed is None else speed, paused
            self._begin_again()
            self._turn.notify_all()

    def ended(self) -> None:
        """Show the end of the run, which the page then keeps. To be called in the thread of the simulation."""
        with self._turn:
            self._speed, self._paused = math.inf, False
        if not self._closing:
            self._time.run(self._time.now + LAST_S)
        self._tell()
        self.live = False

    def close(self) -> None:
        """End the run, if it still runs."""
        with self._turn:
            self._closing = True
            self._turn.notify_all()

    # -- in the thread of the simulation -----------------------------------------------------------------------

    def _join(self, name: str, bus: VirtualBus, robots: int) -> None:
        def take(key: str, payload: bytes) -> None:
            self._newest[name, key] = payload

        def count(key: str, payload: bytes) -> None:
            sender = parse(key).robot
            if sender != name:
                self._hops[sender, name] = self._hops.get((sender, name), 0) + 1

        topics = (*TOPICS, "dwm/pose") if robots <= ESTIMATED else TOPICS
        bus.subscribe([f"swarm/{name}/{topic}" for topic in topics], take)
        if robots < CROWD:
            bus.subscribe([f"swarm/*/{topic}" for topic in FRAMES], count)

    def _tick(self) -> None:
        """Hand over what is new, and wait where virtual time is ahead."""
        self._time.at(self._time.now + TICK_S, self._tick)
        self._now = self._time.now
        real = clock.now()
        if real >= self._told_at + self._tell_every:
            self._tell()
            self._told_at = real
        if real >= self._measured_at + MEASURE_S:
            before, at = self._measured
            self._actual = (self._now - before) / (real - at) if real > at else 0.0
            self._measured, self._measured_at = (self._now, real), real
        with self._turn:
            while not self._closing and (self._paused or (ahead := self._ahead()) > 0.0):
                self._turn.wait(None if self._paused else ahead)
            if self._closing:
                self._time.stop()

    def _ahead(self) -> float:
        """Return the seconds of real time until the present moment is due."""
        virtual, real = self._anchor
        if math.isinf(self._speed):
            return 0.0
        ahead = (self._time.now - virtual) / self._speed - (clock.now() - real)
        if ahead < -BEHIND_S:
            self._begin_again()
        return ahead

    def _begin_again(self) -> None:
        self._anchor = self._time.now, clock.now()

    def _tell(self) -> None:
        newest, self._newest = self._newest, {}
        with self.lock:
            for (robot, key), payload in newest.items():
                self.picture.take(robot, key, payload, self._now)
            for (sender, receiver), count in self._hops.items():
                self.picture.passed(sender, receiver, count)
