"""The interface of a source of a picture, and the source for a simulation on this machine: its buses."""

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

from laptop.view.feeds.picture import Picture
from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.config.types import Config
from swarm.errors import LocalError, PayloadError
from swarm.messages.keys import whose_token
from swarm.onboard.buses import buses
from swarm.onboard.lookout import watch
from swarm.onboard.traffic import Traffic
from swarm.process.paths import bus_endpoint
from swarm.process.simulations import CONFIG, is_live, robots
from swarm.recording.folder import config_in

_log = logging.getLogger("view")

_LOOK_EVERY = 0.5
"""Seconds between two searches for new buses."""


class RobotBus(Protocol):
    """The way to a robot's bus."""

    @property
    def connected(self) -> bool:
        """Return whether the bus is there at this moment."""

    def publish(self, key: str, message: object, *, urgent: bool = False) -> None:
        """Send a message dataclass or raw bytes, which are lost while the bus is away."""


class LiveFeed(Protocol):
    """A source of the present of a swarm."""

    @property
    def kind(self) -> str:
        """Return `simulation`, `robots` or `virtual`."""

    @property
    def picture(self) -> Picture:
        """Return the picture, which callers read under `lock`."""

    @property
    def lock(self) -> threading.Lock:
        """Return the lock of the picture."""

    @property
    def live(self) -> bool:
        """Return whether the swarm still runs."""

    @property
    def config(self) -> Config | None:
        """Return the swarm's config; None while it is unknown."""

    @property
    def buses(self) -> Mapping[str, RobotBus]:
        """Return the way to each robot that has one."""

    def now(self) -> float:
        """Return the page's time, s."""

    def pace(self) -> dict[str, object] | None:
        """Return how fast time passes, where that can be changed: `{speed, actual, paused}`."""

    def set_pace(self, speed: float | None, paused: bool) -> None:
        """Let time pass at another speed, or not at all. Raises `ValueError` where that cannot be."""

    def check_control(self) -> None:
        """Raise `LocalError` where no robot can be told anything at this moment."""


class RealTimeFeed:
    """The parts of a feed of robots in real time, whose pace nobody can change."""

    def __init__(self) -> None:
        self.picture = Picture()
        self.lock = threading.Lock()
        """The lock that protects the picture."""
        self.began = clock.now()
        """The time from which the page counts seconds."""

    def now(self) -> float:
        """Return the page's time, s."""
        return clock.now() - self.began

    def pace(self) -> None:
        """Return None: nobody can change the pace of real time."""

    def set_pace(self, speed: float | None, paused: bool) -> None:
        """Refuse: this is real time."""
        raise ValueError("this is real time")


class SimulationFeed(RealTimeFeed):
    """Watches the bus of every robot of a running simulation until closed."""

    kind = "simulation"

    def __init__(self, directory: Path, only: Sequence[str]) -> None:
        """`only`: the robots to watch, all where none is named. Raises `LocalError` where no simulation runs there."""
        if not is_live(directory):
            raise LocalError(
                f"no simulation is running in {directory}: start one with `swarm sim`, or name --run-dir; "
                "a swarm.toml (--config) names real robots"
            )
        self._only = only
        buses.only_wanted(robots(directory), only)
        super().__init__()
        self.directory = directory
        self.live = True
        """Whether the run was still going on at the last look."""
        self.config: Config | None = None
        """The swarm's configuration; None until it is known."""
        self._config_time = 0
        """The time at which the configuration's file was written, ns."""
        self.buses: dict[str, Bus] = {}
        """The bus of each robot."""
        self._traffic: dict[str, Traffic] = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._look, name="feed", daemon=True)
        self._thread.start()

    def check_control(self) -> None:
        """Raise `LocalError` where no robot can be told anything at this moment."""
        if not self.live:
            raise LocalError("the simulation has ended")

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        for bus in self.buses.values():
            bus.close()

    def _look(self) -> None:
        while not self._closing.wait(_LOOK_EVERY if self.buses else 0.05):
            try:
                self._look_once()
            except Exception:  # noqa: BLE001 - a defect here; the next look may do better
                _log.exception("a look at the simulation has failed")
                self._closing.wait(_LOOK_EVERY)

    def _look_once(self) -> None:
        self.live = is_live(self.directory)
        self._read_config()
        if self.config is None or not self.buses.keys() >= set(self.config.names):
            self._join()
        for each in self._traffic.values():
            each.look(self.now())

    def _read_config(self) -> None:
        """Read the configuration where it was written after the last look, as by the next run in this directory, and
        leave robots that are not in it."""
        try:
            written = (self.directory / CONFIG).stat().st_mtime_ns
        except OSError:
            return  # there is none between two runs
        if written == self._config_time or (config := config_in(self.directory)) is None:
            return
        self._config_time, self.config = written, config
        gone = {name: bus for name, bus in self.buses.items() if name not in config.names}
        self.buses = {name: bus for name, bus in self.buses.items() if name not in gone}
        for name, bus in gone.items():
            self._traffic.pop(name, None)
            bus.close()

    def _join(self) -> None:
        """Watch the buses that have come."""
        for name, runtime in robots(self.directory).items():
            if name not in self.buses and (not self._only or name in self._only):
                bus = Bus(bus_endpoint(runtime))
                self.buses = {**self.buses, name: bus}  # other threads may go through the old one
                watch(bus, name, self._taker(name), self._alive)
                self._traffic[name] = Traffic(bus, name, self._counter(name))

    def _taker(self, robot: str) -> Callable[[str, bytes], None]:
        def take(key: str, payload: bytes) -> None:
            with self.lock:
                self.picture.take(robot, key, payload, self.now())

        return take

    def _counter(self, robot: str) -> Callable[[str, int], None]:
        def passed(sender: str, count: int) -> None:
            with self.lock:
                self.picture.passed(sender, robot, count)

        return passed

    def _alive(self, key: str, there: bool) -> None:
        try:
            robot, service = whose_token(key)
        except PayloadError:
            return
        with self.lock:
            self.picture.alive(robot, service, there, self.now())
