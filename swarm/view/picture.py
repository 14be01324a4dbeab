"""What is known of the swarm at this moment: the newest sample of every key, what just happened, and who is there.

A page asks for everything once and then for what has changed since its last version, so a slow one gets fewer steps and
never a queue. No IO and no clock: samples come in from whatever watches the robots, a bus or a recording.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from swarm.codec import unpack
from swarm.errors import PayloadError
from swarm.keys import parse
from swarm.plain import plain

MAX_EVENTS = 500
HISTORY_S = 120.0
"""How far back numbers are kept for a chart that is opened late, s."""

HISTORY_STEP_S = 0.2
"""s between two entries of it at least."""

MAX_TOPICS = 256
"""Keys of one robot that are shown; an app that publishes under ever new ones must not fill the memory."""

MAX_BYTES = 256
"""Of a raw payload within a message that a page is told."""

MAX_NAMED = 6
"""Robots that are waited for and named in an event."""

TRAIL_S = 30.0
"""How much of its way a robot draws behind it, s."""


REACH = "view/reach"
"""What this side says of a real robot: `by` ssh, the mesh or nothing, and `why`."""


class Event(NamedTuple):
    """Something worth a line."""

    number: int
    t: float
    robot: str
    level: str
    """`info`, `warning` or `error`."""
    text: str


class Picture:
    """The swarm as it is. Times are the caller's clock, s."""

    def __init__(self) -> None:
        self.version = 0
        self.events: deque[Event] = deque(maxlen=MAX_EVENTS)
        self.refused = 0
        """Samples that are no message."""
        self._topics: dict[str, dict[str, tuple[int, object]]] = {}
        self._alive: dict[str, dict[str, bool]] = {}
        self._history: dict[tuple[str, str], deque[tuple[float, object]]] = {}
        self._hops: dict[str, int] = {}
        self._numbered = 0
        self._told: dict[tuple[str, str], object] = {}

    def take(self, bus: str, key: str, payload: bytes, now: float) -> None:
        """A sample seen on a robot's bus (`bus` = "" for the only one). What another robot's key brings there counts as
        a message between the two."""
        try:
            robot, service, topic = parse(key)
        except PayloadError:
            self.refused += 1
            return
        chunks = topic.split("/")
        if service == "app" and len(chunks) > 1 and chunks[1] in ("sync", "latest"):
            if bus not in ("", robot):
                edge = f"{robot}>{bus}"
                self._hops[edge] = self._hops.get(edge, 0) + 1
            return
        if bus not in ("", robot):
            return
        try:
            value = plain(unpack(payload), MAX_BYTES)
        except PayloadError:
            self.refused += 1
            return
        self.put(robot, f"{service}/{topic}", value, now)

    def passed(self, sender: str, receiver: str, count: int) -> None:
        """How many messages have passed between the two so far, from whoever counts them."""
        self._hops[f"{sender}>{receiver}"] = count

    def put(self, robot: str, topic: str, value: object, now: float) -> None:
        """A decoded sample."""
        topics = self._topics.setdefault(robot, {})
        if topic not in topics and len(topics) >= MAX_TOPICS:
            self.refused += 1
            return
        self.version += 1
        topics[topic] = self.version, value
        history = self._history.setdefault((robot, topic), deque())
        if not history or now >= history[-1][0] + HISTORY_STEP_S or now < history[-1][0]:
            history.append((now, value))
            while history[0][0] < now - HISTORY_S:
                history.popleft()
        for level, text, subject in _news(topic, value):
            if self._told.get((robot, subject)) != text:
                before = self._told.get((robot, subject))
                self._told[robot, subject] = text
                if before is not None or level != "info":
                    self._tell(now, robot, level, text)

    def alive(self, robot: str, service: str, there: bool, now: float) -> None:
        """A service's process has come or gone."""
        services = self._alive.setdefault(robot, {})
        before = services.get(service)
        if before == there:
            return
        services[service] = there
        self.version += 1
        if before is not None:
            self._tell(now, robot, "info" if there else "error", f"{service} is {'back' if there else 'gone'}")

    def services(self) -> dict[str, dict[str, bool]]:
        """Which services have been there, by robot, and whether they are now."""
        return self._alive

    def newest(self, robot: str, topic: str) -> object:
        """The newest value of a key; None where there is none."""
        return self._topics.get(robot, {}).get(topic, (0, None))[1]

    def since(self, version: int) -> dict[str, dict[str, object]]:
        """Samples newer than a version, by robot and topic."""
        found: dict[str, dict[str, object]] = {}
        for robot, topics in self._topics.items():
            new = {topic: value for topic, (number, value) in topics.items() if number > version}
            if new:
                found[robot] = new
        return found

    def events_since(self, number: int) -> list[Event]:
        """Events behind a number, oldest first."""
        return [event for event in self.events if event.number > number]

    def hops(self) -> dict[str, int]:
        """Messages that have passed so far, by `sender>receiver`."""
        return dict(self._hops)

    def history(self, robot: str, topic: str) -> list[tuple[float, object]]:
        """What a key held in the last two minutes, oldest first."""
        return list(self._history.get((robot, topic), ()))

    def trail(self, robot: str, topic: str, seconds: float, now: float) -> list[tuple[float, float]]:
        """The way that a robot has come, m."""
        return list(places(self.history(robot, topic), now - seconds))

    def _tell(self, now: float, robot: str, level: str, text: str) -> None:
        self._numbered += 1
        self.version += 1
        self.events.append(Event(self._numbered, now, robot, level, text))


def places(history: Iterable[tuple[float, object]], since: float) -> Iterator[tuple[float, float]]:
    """Where a robot has been since a time, m, by what a key with `x` and `y` held."""
    for t, value in history:
        if t >= since and isinstance(value, dict):
            x, y = value.get("x"), value.get("y")
            if isinstance(x, int | float) and isinstance(y, int | float):
                yield float(x), float(y)


def _news(topic: str, value: object) -> Iterator[tuple[str, str, str]]:
    """Level, text and subject of what a message says that a person should read once."""
    if not isinstance(value, dict):
        return
    service, _, kind = topic.rpartition("/")
    if topic == "mesh/links":
        for link in value.get("links") or ():
            if isinstance(link, dict):
                state, reason = link.get("state"), link.get("reason")
                begins = reason == "not connected yet"
                level = "info" if begins else {"up": "info", "connecting": "info"}.get(str(state), "warning")
                text = f"link to {link.get('peer')} {state}" + (f": {reason}" if reason and state == "down" else "")
                if state != "connecting":
                    yield level, text, f"link {link.get('peer')}"
    elif kind == "status":
        state = value.get("state")
        level = "warning" if state == "degraded" else "info"
        yield level, f"{service} {state}" + (f": {value['reason']}" if value.get("reason") else ""), service
    elif kind == "progress" and service.startswith("app/"):
        phase, waiting = value.get("phase"), value.get("waiting_for") or []
        text = f"{service} {phase}"
        if isinstance(waiting, list) and waiting:
            text += " for " + " ".join(map(str, waiting[:MAX_NAMED]))
            if len(waiting) > MAX_NAMED:
                text += f" and {len(waiting) - MAX_NAMED} more"
        if value.get("reason"):
            text += f": {value['reason']}"
        yield {"fault": "error", "waiting": "warning"}.get(str(phase), "info"), text, f"{service} phase"
    elif topic == "balancer/fault":
        name = value.get("name")
        yield "error" if name else "info", f"fault {name}: {value.get('reason')}" if name else "no fault", "fault"
    elif topic == REACH:
        by, why = value.get("by"), value.get("why")
        yield ("info", f"seen by {by}", "reach") if by else ("warning", f"out of reach: {why}", "reach")
    elif topic == "mesh/stopped":
        stopped = value.get("stopped")
        yield "error" if stopped else "info", "stopped" if stopped else "not stopped", "stopped"
