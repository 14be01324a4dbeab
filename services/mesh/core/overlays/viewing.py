"""The reports of a robot to somebody who watches the swarm through another one, and how long they last.

Who watches says so on the bus of any robot (`mesh/set/watch`); that robot's mesh floods it, and each other one sends
it a short message a second until the time is over: nothing is carried that nobody looks at, and a viewer that is
gone is forgotten by itself. A message holds the newest values of the keys that a person looks at, a few fields of each,
so that all of it together is one packet; the bulk class, and a newer one takes the place of one that still waits.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import msgpack

from swarm.errors import PayloadError
from swarm.messages import Status, View, Watch
from swarm.messages.codec import MAX_PAYLOAD, decode, encode, unpack
from swarm.messages.keys import whose_token

LONGEST_S = 60.0
"""Most seconds of one request."""

REPEAT_S = 2.0
"""Seconds between two requests that are flooded at least: two viewers cost no more than one."""

PERIOD_S = 1.0
BUDGET = 1000.0
"""bytes/s that may come to one robot that is watched through, 1.3 % of a Bluetooth link. On a line each hop of a view
holds up lockstep once, and these add up: with 4000 bytes/s an iteration took 10 % longer on a line of eight."""

TYPICAL = 250.0
"""bytes of a view with its packet and its answer, on average, for the budget."""

FULL_EVERY = 8
"""Views of which one has everything; the others have what has changed. One that was lost is made good by that."""

LARGEST = 1000
"""bytes of a view; what does not fit is left out."""

MAX_STATE = 80
"""Letters of a service's state and its reason."""

MAX_APP_KEYS = 64
"""Keys of apps whose newest values are kept; an app that publishes under ever new names must not fill the memory."""

MAX_APP_BYTES = 1 << 20
"""Bytes of these values together, for the same reason."""

MAX_SERVICES = 64
"""Services that are told of, for the same reason."""

_LINK = ("peer", "state", "rtt", "sent_rate", "reason")

DECIMALS = {"x": 3, "y": 3, "heading": 2, "tilt": 1, "battery": 1, "quality": -1}
DIGITS = {"deviation_x": 1, "deviation_y": 1, "battery_left": 2, "rtt": 2, "sent_rate": 1, "error": 1}
"""Places after the point, and significant digits, of what would change all the time for nobody's good."""

FIELDS: Mapping[str, tuple[str, ...]] = {
    "dwm/pose": ("x", "y", "heading", "quality", "deviation_x", "deviation_y"),
    "balancer/state": ("mode", "tilt", "battery", "battery_level", "battery_left", "fault"),
    "mesh/links": ("links",),
    "app/*/progress": ("phase", "waiting_for", "reason"),
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
    """The robots that watch this one. Calls with `now` must not go back in time."""

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
        self._told: dict[str, bytes] = {}
        """What whoever watches knows."""
        self._told_services: dict[str, str] = {}
        self._number = 0

    def ask(self, now: float) -> bool:
        """Somebody watches through this robot: whether the others are to be told."""
        if now < self._flooded_at + REPEAT_S:
            return False
        self._flooded_at = now
        return True

    def asked(self, watch: Watch, origin: str, now: float) -> None:
        """Somebody watches through another robot."""
        seconds = min(max(0.0, watch.seconds), LONGEST_S)
        self.active(now)
        if origin not in self._leases:
            self._number = 0
        self._leases[origin] = now + seconds

    def active(self, now: float) -> bool:
        """Return whether anybody watches; if not, all that was heard is forgotten."""
        self._leases = {origin: until for origin, until in self._leases.items() if until > now}
        if not self._leases:
            self._values.clear()
            self._there.clear()
            self._states.clear()
        return bool(self._leases)

    def take(self, key: str, payload: bytes) -> None:
        """Take a sample of the own bus; other keys are ignored."""
        topic = key.removeprefix(self._prefix)
        if topic == key:
            return
        if _kind(topic) is not None:
            self._keep(topic, payload)
        elif topic.endswith("/status"):
            self._hear_status(topic.removesuffix("/status"), key, payload)

    def alive(self, key: str, there: bool) -> None:
        """Note that a service's process of this robot has come or gone."""
        try:
            robot, service = whose_token(key)
        except PayloadError:
            return
        if f"swarm/{robot}/" == self._prefix and (service in self._there or len(self._there) < MAX_SERVICES):
            self._there[service] = there

    def due(self, now: float) -> tuple[tuple[str, ...], bytes] | None:
        """Return the robots to which a view is to be sent now, and the view; None where nothing is due."""
        if not self.active(now) or now < self._due:
            return None
        self._due = max(self._due + self._period, now)
        return tuple(sorted(self._leases)), self._view(now)

    def _keep(self, topic: str, payload: bytes) -> None:
        """Keep it as the newest value. One that has no room is left out, and so is the older one: it holds no more."""
        self._values.pop(topic, None)
        if len(payload) > MAX_PAYLOAD:
            return
        if topic not in FIELDS:  # of an app, which takes no room away from the robot's own services
            sizes = [len(name) + len(value) for name, value in self._values.items() if name not in FIELDS]
            if len(sizes) >= MAX_APP_KEYS or sum(sizes) + len(topic) + len(payload) > MAX_APP_BYTES:
                return
        self._values[topic] = payload

    def _hear_status(self, service: str, key: str, payload: bytes) -> None:
        if service not in self._states and len(self._states) >= MAX_SERVICES:
            return
        try:
            status = decode(Status, payload, key)
        except PayloadError:
            return
        told = f"{status.state}: {status.reason}" if status.reason else status.state
        self._states[service] = told[:MAX_STATE]

    def _view(self, now: float) -> bytes:
        services = {
            name: self._states.get(name, HERE) if there else GONE for name, there in sorted(self._there.items())
        }
        if self._number % FULL_EVERY == 0:
            self._told.clear()
            self._told_services.clear()
        self._number += 1
        news: dict[str, str] = {}
        values: dict[str, bytes] = {}
        size = 0
        for name, text in services.items():
            more = len(name) + len(text.encode())
            if self._told_services.get(name) != text and size + more <= LARGEST:
                news[name] = self._told_services[name] = text
                size += more
        found = sorted((_ORDER[kind], topic) for topic in self._values if (kind := _kind(topic)) is not None)
        for _, topic in found:
            data = _shortened(topic, self._values[topic])
            if data is None or self._told.get(topic) == data or size + len(topic) + len(data) > LARGEST:
                continue
            values[topic] = self._told[topic] = data
            size += len(topic) + len(data)
        return encode(View(now, news, values))


def _kind(topic: str) -> str | None:
    """Return which of `FIELDS` a topic is."""
    if topic in FIELDS:
        return topic
    head, _, last = topic.rpartition("/")
    return kind if head.startswith("app/") and (kind := f"app/*/{last}") in FIELDS else None


def _shortened(topic: str, payload: bytes) -> bytes | None:
    """Return a message with the chosen fields alone, numbers in 32 bits; None where it is no message."""
    kind = _kind(topic)
    try:
        message = unpack(payload)
    except PayloadError:
        return None
    if not isinstance(message, dict) or kind is None:
        return None
    chosen = _chosen(message, FIELDS[kind])
    if kind == "mesh/links" and isinstance(chosen.get("links"), list):
        links = (_chosen(link, _LINK) for link in chosen["links"] if isinstance(link, dict))
        chosen["links"] = [{name: value for name, value in link.items() if value not in ("", None)} for link in links]
    try:
        packed: bytes = msgpack.packb(chosen, use_single_float=True)
    except (TypeError, ValueError, OverflowError):
        return None
    return packed


def _chosen(message: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    return {name: _rounded(name, message[name]) for name in names if name in message}


def _rounded(name: str, value: object) -> object:
    if isinstance(value, float) and math.isfinite(value):
        if name in DECIMALS:
            return round(value, DECIMALS[name])
        if name in DIGITS:
            return float(f"{value:.{DIGITS[name]}g}")
    return value
