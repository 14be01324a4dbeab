"""The simulation's view of its robots: the same keys that anyone can watch, on every robot's bus."""

import contextlib
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from swarm.bus.throttle import THROTTLED, Throttle
from swarm.bus.zenoh_bus import Bus
from swarm.errors import PayloadError
from swarm.messages import (
    AppEpoch,
    AppLog,
    AppProgress,
    AppState,
    BalancerState,
    LedChange,
    Links,
    Status,
    Target,
    Truth,
    read,
)
from swarm.messages.keys import key, parse
from swarm.messages.sim import THROTTLED_TRUTH_S
from swarm.recording.file import UNRECORDED

MOST_SAID = 1000
"""Lines of apps that wait to be shown; the oldest are lost."""

_TRUTHS = {Truth: "truth", Target: "target", LedChange: "leds"}


@dataclass
class Seen:
    """The latest messages of one robot."""

    status: dict[str, Status] = field(default_factory=dict)
    """The status by service."""
    balancer: BalancerState | None = None
    links: Links | None = None
    progress: AppProgress | None = None
    state: AppState | None = None
    epoch: AppEpoch | None = None
    sent_before: int = 0
    """Messages of its meshes that have ended, as each of them told last."""

    def take_status(self, status: Status) -> None:
        """Take the status of a service. A mesh that was started again counts its messages from zero."""
        before = self.status.get(status.service)
        if status.service == "mesh" and before is not None and before.pid != status.pid:
            self.sent_before += before.counters.get("sent_sync", 0)
        self.status[status.service] = status

    def not_ready(self, services: Sequence[str]) -> list[str]:
        """Return which of `services` have not finished starting (a degraded one has)."""
        return [name for name in services if name not in self.status or self.status[name].state == "starting"]


_LATEST: dict[type, str] = {
    BalancerState: "balancer",
    Links: "links",
    AppProgress: "progress",
    AppState: "state",
    AppEpoch: "epoch",
}
"""Attribute of `Seen` for the latest message of each type."""

_APP_TOPICS = ("progress", f"state/{THROTTLED}", "epoch")
"""Topics of the app that is followed."""


START_LIMIT_S = 60.0
"""Seconds in which nothing more becomes ready, after which a swarm that has not done its first iteration is given
up. A busy machine may take longer for the whole start; as long as more and more is ready, that is no fault of the
swarm."""


class StartTimeout:
    """Watches how much of a starting swarm is ready."""

    def __init__(self, now: float) -> None:
        self._most, self._since = 0, now

    def lost(self, ready: int, now: float) -> bool:
        """Take how many things are ready now; return whether the most so far is as old as `START_LIMIT_S`."""
        if ready > self._most:
            self._most, self._since = ready, now
        return now - self._since > START_LIMIT_S


class Monitor:
    """Watches the buses of all robots and publishes the simulated truth on them.

    Samples are kept as they came and decoded when somebody looks, each once: many are replaced before that, most are
    the same as at the last look, and the simulation's own process should take little from the robots it watches.
    """

    def __init__(self, run_dir: Path, names: Sequence[str], app: str | None) -> None:
        """`app` is the one whose progress is followed; others may be started meanwhile."""
        self._app = app
        self._samples: dict[str, dict[str, bytes]] = {name: {} for name in names}
        self._seen = {name: Seen() for name in names}
        self._decoded: dict[str, bytes] = {}  # by key: the sample that is in `_seen`
        self._buses = {name: Bus.of(run_dir / name) for name in names}
        self._throttles = {
            name: Throttle(bus, key(name, "sim", "truth"), THROTTLED_TRUTH_S) for name, bus in self._buses.items()
        }
        self._said: deque[tuple[str, bytes]] = deque(maxlen=MOST_SAID)
        for name, bus in self._buses.items():
            bus.subscribe(key(name, "app", "*", "log"), lambda *sample: self._said.append(sample))
            bus.subscribe(
                [
                    key(name, "*", "status"),
                    key(name, "app", "*", "status"),
                    *([key(name, "app", app, topic) for topic in _APP_TOPICS] if app else []),
                    key(name, "balancer", "state", THROTTLED),
                    key(name, "mesh", "links"),
                ],
                self._samples[name].__setitem__,
            )

    def truth(self, robot: str, message: Truth | Target | LedChange) -> None:
        """Publish where a robot or the target really is, or what a robot's LEDs show."""
        if isinstance(message, Truth):
            self._throttles[robot].publish(message, message.t)
        self._buses[robot].publish(key(robot, "sim", _TRUTHS[type(message)]), message)

    def ask_status(self) -> None:
        """Ask every service for its status, and the app for its members: what was published before we were connected
        is lost."""
        for name, bus in self._buses.items():
            epoch = [key(name, "app", self._app, "epoch")] if self._app else []
            for pattern in (key(name, "*", "status"), key(name, "app", "*", "status"), *epoch):
                bus.ask(pattern, self._samples[name].__setitem__)

    def look(self) -> dict[str, Seen]:
        """Return the latest messages of every robot, by name. The next look changes them."""
        for name, samples in self._samples.items():
            # dict() of a dict is one step of the interpreter: Zenoh's threads may be storing meanwhile.
            for topic, payload in dict(samples).items():
                if self._decoded.get(topic) is not payload:
                    self._decoded[topic] = payload
                    _update(self._seen[name], topic, payload)
        return self._seen

    def said(self) -> list[tuple[str, AppLog]]:
        """Return robot and line for all that apps have printed and logged since the last call."""
        found = []
        while self._said:
            topic, payload = self._said.popleft()
            with contextlib.suppress(PayloadError):
                line = read(topic, payload)
                assert isinstance(line, AppLog)
                found.append((parse(topic).robot, line))
        return found

    def close(self) -> None:
        for bus in self._buses.values():
            bus.close()


def unrecorded(seen: Mapping[str, Seen]) -> list[str]:
    """Return which apps could not record the end of the run, and why."""
    told = ((name, status) for name, robot in seen.items() for status in robot.status.values())
    return [
        f"{name} {status.service}: {status.reason}" for name, status in told if status.reason.startswith(UNRECORDED)
    ]


def _update(seen: Seen, topic: str, payload: bytes) -> None:
    try:
        message = read(topic, payload)
    except PayloadError:
        return  # a picture for people: whoever needs the message reports what is wrong with it
    if isinstance(message, Status):
        seen.take_status(message)
    elif (kind := type(message)) in _LATEST:
        setattr(seen, _LATEST[kind], message)
