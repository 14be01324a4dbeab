"""What a robot tells of itself to somebody who watches the swarm through another one, and for how long.

Who watches says so on the bus of any robot (`mesh/set/watch`); that robot's mesh floods it, and each other one sends
it a short message a second until the time is over: nothing is carried that nobody looks at, and a viewer that is
gone is forgotten by itself. A message holds the newest values of the keys that a person looks at, a few fields of each,
so that all of it together is one packet; the bulk class, and a newer one takes the place of one that still waits.
"""

from collections.abc import Mapping
from typing import Any

import msgpack

from swarm.codec import decode, encode, unpack
from swarm.errors import PayloadError
from swarm.keys import parse
from swarm.messages import Status, View, Watch

LONGEST_S = 60.0
"""Of one request."""

REPEAT_S = 2.0
"""s between two requests that are flooded at least: two viewers cost no more than one."""

PERIOD_S = 1.0
BUDGET = 4000.0
"""bytes/s that may come to one robot that is watched through: 5 % of a Bluetooth link."""

TYPICAL = 700.0
"""bytes of a view with its packet and its answer, for the budget: four services, two links, an app."""

LARGEST = 1000
"""bytes of a view; what does not fit is left out."""

MAX_REASON = 60
"""Letters of why a service is degraded."""

_LINK = ("peer", "state", "rtt", "sent_rate", "reason")

FIELDS: Mapping[str, tuple[str, ...]] = {
    "dwm/pose": ("x", "y", "heading", "quality", "deviation_x", "deviation_y"),
    "balancer/state": ("mode", "tilt", "battery", "battery_level", "battery_left", "fault"),
    "mesh/links": ("links",),
    "app/*/progress": ("phase", "k", "waiting_for", "reason"),
    "app/*/state": ("k", "state", "result"),
    "balancer/leds": ("red", "yellow", "green"),
    "balancer/fault": ("name", "reason"),
    "mesh/clock": ("root", "error"),
}
"""What is told of which keys, the most important first; `*` is a name."""

KEYS = (*FIELDS, "*/status", "app/*/status")
"""The keys that are to be heard, below the robot's name."""

HERE, GONE = "here", "gone"
"""A service that has not said how it is, and one whose process has ended."""

_ORDER = {topic: number for number, topic in enumerate(FIELDS)}


class Viewing:
    """Of one robot. Calls with `now` must not go back in time."""

    def __init__(self, robot: str, robots: int) -> None:
        """`robots`: how many the swarm has, by which the budget of a watched one is shared."""
        self._prefix = f"swarm/{robot}/"
        self._period = max(PERIOD_S, robots * TYPICAL / BUDGET)
        self._leases: dict[str, float] = {}
        self._flooded_at = -REPEAT_S
        self._due = 0.0
        self._values: dict[str, bytes] = {}
        self._there: dict[str, bool] = {}
        self._states: dict[str, str] = {}

    def ask(self, now: float) -> bool:
        """Somebody watches through this robot: whether the others are to be told."""
        if now < self._flooded_at + REPEAT_S:
            return False
        self._flooded_at = now
        return True

    def asked(self, watch: Watch, origin: str, now: float) -> None:
        """Somebody watches through another robot."""
        seconds = min(max(0.0, watch.seconds), LONGEST_S)
        self._leases[origin] = now + seconds

    def active(self, now: float) -> bool:
        """Whether anybody watches; if not, all that was heard is forgotten."""
        self._leases = {origin: until for origin, until in self._leases.items() if until > now}
        if not self._leases:
            self._values.clear()
            self._there.clear()
            self._states.clear()
        return bool(self._leases)

    def take(self, key: str, payload: bytes) -> None:
        """A sample of the own bus; what is none of the keys is left alone."""
        topic = key.removeprefix(self._prefix)
        if topic == key:
            return
        if _kind(topic) is not None:
            self._values[topic] = payload
        elif topic.endswith("/status"):
            self._hear_status(topic.removesuffix("/status"), key, payload)

    def alive(self, key: str, there: bool) -> None:
        """A service's process of this robot has come or gone."""
        try:
            robot, service, topic = parse(key)
        except PayloadError:
            return
        if f"swarm/{robot}/" == self._prefix:
            self._there["/".join((service, *topic.split("/")[:-1]))] = there

    def due(self, now: float) -> tuple[tuple[str, ...], bytes] | None:
        """To whom a view is to be sent now, and what; None where nothing is due."""
        if not self.active(now) or now < self._due:
            return None
        self._due = max(self._due + self._period, now)
        return tuple(sorted(self._leases)), self._view(now)

    def _hear_status(self, service: str, key: str, payload: bytes) -> None:
        try:
            status = decode(Status, payload, key)
        except PayloadError:
            return
        self._states[service] = f"{status.state}: {status.reason[:MAX_REASON]}" if status.reason else status.state

    def _view(self, now: float) -> bytes:
        services = {
            name: self._states.get(name, HERE) if there else GONE for name, there in sorted(self._there.items())
        }
        values: dict[str, bytes] = {}
        size = sum(len(name) + len(state) for name, state in services.items())
        found = sorted((_ORDER[kind], topic) for topic in self._values if (kind := _kind(topic)) is not None)
        for _, topic in found:
            data = _shortened(topic, self._values[topic])
            if data is not None and size + len(topic) + len(data) <= LARGEST:
                values[topic] = data
                size += len(topic) + len(data)
        return encode(View(now, services, values))


def _kind(topic: str) -> str | None:
    """Which of `FIELDS` a topic is."""
    if topic in FIELDS:
        return topic
    head, _, last = topic.rpartition("/")
    return kind if head.startswith("app/") and (kind := f"app/*/{last}") in FIELDS else None


def _shortened(topic: str, payload: bytes) -> bytes | None:
    """A message with the chosen fields alone, numbers in 32 bits; None where it is no message."""
    kind = _kind(topic)
    try:
        message = unpack(payload)
    except PayloadError:
        return None
    if not isinstance(message, dict) or kind is None:
        return None
    chosen: dict[str, Any] = {name: message[name] for name in FIELDS[kind] if name in message}
    if kind == "mesh/links" and isinstance(chosen.get("links"), list):
        chosen["links"] = [
            {name: link[name] for name in _LINK if link.get(name) not in ("", None)}
            for link in chosen["links"]
            if isinstance(link, dict)
        ]
    try:
        packed: bytes = msgpack.packb(chosen, use_single_float=True)
    except (TypeError, ValueError, OverflowError):
        return None
    return packed
