"""What the simulation sees of its robots: the same keys anyone can watch, on every robot's bus."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from swarm.bus import Bus
from swarm.errors import PayloadError
from swarm.keys import key, parse
from swarm.messages import AppProgress, AppState, BalancerState, Links, Pose, Status, Truth, read


@dataclass
class Seen:
    """The latest of one robot."""

    status: dict[str, Status] = field(default_factory=dict)
    """By service."""
    balancer: BalancerState | None = None
    links: Links | None = None
    pose: Pose | None = None
    progress: AppProgress | None = None
    state: AppState | None = None


class Monitor:
    """Watches the buses of all robots and publishes the simulated truth on them."""

    def __init__(self, run_dir: Path, names: Sequence[str]) -> None:
        self.seen = {name: Seen() for name in names}
        self._lock = threading.Lock()
        self._buses = {name: Bus.of(run_dir / name) for name in names}
        for name, bus in self._buses.items():
            bus.subscribe(
                [
                    key(name, "*", "status"),
                    key(name, "app", "*", "status"),
                    key(name, "app", "*", "progress"),
                    key(name, "app", "*", "state"),
                    key(name, "balancer", "state"),
                    key(name, "mesh", "links"),
                    key(name, "dwm", "pose"),
                ],
                self._take,
            )

    def truth(self, robot: str, message: Truth) -> None:
        """Publish where a robot really is."""
        self._buses[robot].publish(key(robot, "sim", "truth"), message)

    def ask_status(self) -> None:
        """Ask every service for its status: what was published before we were connected is lost."""
        for name, bus in self._buses.items():
            for pattern in (key(name, "*", "status"), key(name, "app", "*", "status")):
                bus.ask(pattern, self._take)

    def services_ready(self, robot: str, services: Sequence[str]) -> list[str]:
        """Which of `services` are not ready (or degraded, which runs too)."""
        with self._lock:
            status = self.seen[robot].status
            return [name for name in services if name not in status or status[name].state == "starting"]

    def snapshot(self) -> dict[str, Seen]:
        """A consistent copy of what was seen."""
        with self._lock:
            return {
                name: Seen(dict(seen.status), seen.balancer, seen.links, seen.pose, seen.progress, seen.state)
                for name, seen in self.seen.items()
            }

    def close(self) -> None:
        """Leave all buses."""
        for bus in self._buses.values():
            bus.close()

    def _take(self, name: str, payload: bytes) -> None:
        try:
            message = read(name, payload)
        except PayloadError:
            return  # a picture for people: whoever needs the message reports what is wrong with it
        seen = self.seen[parse(name).robot]
        with self._lock:
            match message:
                case Status():
                    seen.status[message.service] = message
                case BalancerState():
                    seen.balancer = message
                case Links():
                    seen.links = message
                case Pose():
                    seen.pose = message
                case AppProgress():
                    seen.progress = message
                case AppState():
                    seen.state = message
