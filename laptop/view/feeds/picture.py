"""The present state of the swarm: the newest sample of every key, the latest events, and which robots are there.

A page asks for everything once and then for what has changed since its last version, so a slow one gets fewer steps and
never a queue. No IO and no clock: samples come in from whatever watches the robots, a bus or a recording.

Robots may say anything: a message whose fields have not the types of its key is dropped, counted, and named once among
the events. So pages find numbers, texts and lists where they look for them, or nothing.
"""

import contextlib
import math
from collections import Counter, deque
from collections.abc import Container, Iterable, Iterator
from contextlib import AbstractContextManager
from functools import lru_cache
from typing import NamedTuple

from laptop.view.feeds.history import History
from laptop.view.feeds.news import REACH, news
from swarm.errors import PayloadError
from swarm.messages import type_of
from swarm.messages.codec import unpack
from swarm.messages.fields import check_fields
from swarm.messages.json_values import is_number, json_value
from swarm.messages.keys import parse
from swarm.process.text import printable

MAX_EVENTS = 500
MAX_TOPICS = 256
"""The most keys of one robot that are shown: an app that publishes under ever new keys must not fill the memory."""

MAX_SIZE = 1 << 20
"""The most bytes of the newest samples of one robot together: large samples must not fill the memory."""

MAX_SERVICES = 64
"""The most services of one robot that are shown: a robot that names ever new ones must not fill the memory."""

MAX_SUBJECTS = 256
"""The most subjects of one robot (links, services) whose last event is remembered: ever new names must not fill the
memory."""

MAX_HOPS = 4096
"""The most pairs of robots whose messages are counted: ever new names of senders must not fill the memory."""

MAX_PARTS = 10_000
"""The most values in one message that a page gets: a topology of 255 robots has 3000."""

MAX_BYTES = 256
"""The most bytes of a raw payload within a message that a page gets."""

TRAIL_S = 30.0
"""Length of the trail behind a robot, s."""


AT_ONCE = frozenset(("sim/truth", "sim/leds", "balancer/leds"))
"""Topics of what moves on the map. A page gets them as often as it can draw them. If no true pose is known, `dwm/pose`
is one of them."""


class Event(NamedTuple):
    """A line about something that has happened."""

    number: int
    t: float
    robot: str
    level: str
    """`info`, `warning` or `error`."""
    text: str


_NO_LOCK = contextlib.nullcontext()
_NOTHING = object()
"""The value that stands for a payload that could not be decoded."""

_TOLD = frozenset(("mesh/links", "mesh/stopped", "balancer/fault", REACH))
_TOLD_OF_ALL = ("/status", "/progress")
"""Topics, and endings of topics, that cause events."""


class _Packed:
    """A sample in its encoded form, which is decoded when somebody asks."""

    def __init__(self, payload: bytes) -> None:
        self.payload = payload
        self.value: object = None

    def decode(self, topic: str) -> object:
        """Return the message. Where it is none, raise `PayloadError` once, then return `_NOTHING`. Several threads may
        call this at the same time."""
        if self.value is None:
            try:
                self.value = _message(topic, self.payload)
            except PayloadError:
                self.value = _NOTHING
                raise
        return self.value


class Picture:
    """The swarm as it is. Times are the caller's clock, s."""

    def __init__(self) -> None:
        self.version = 0
        self.events: deque[Event] = deque(maxlen=MAX_EVENTS)
        self.refused = 0
        """Number of samples that were dropped."""
        self._named: set[tuple[str, str]] = set()
        """Robots and topics whose wrong messages have been reported."""
        self._now = 0.0
        """Time of the newest sample."""
        self._topics: dict[str, dict[str, tuple[int, object]]] = {}
        self._alive: dict[str, dict[str, bool]] = {}
        self._sizes: Counter[str] = Counter()
        """Bytes of the newest samples of each robot."""
        self._history: dict[str, History] = {}
        self._hops: dict[str, int] = {}
        self._numbered = 0
        self._told: dict[str, dict[str, str]] = {}
        """The last event by robot and subject."""

    def take(self, bus: str, key: str, payload: bytes, now: float) -> None:
        """Take a sample seen on a robot's bus (`bus` = "": on any one). On its own bus no other robot speaks for
        itself."""
        try:
            robot, service, topic = parse(key)
        except PayloadError:
            self.refused += 1
            return
        if bus not in ("", robot):
            return
        self._now = now
        name, packed = f"{service}/{topic}", _Packed(payload)
        if name in _TOLD or name.endswith(_TOLD_OF_ALL):
            value = self._open(robot, name, packed)
            if value is _NOTHING or not self._keep(robot, name, packed):
                return
            self._read(robot, name, value, now)
        elif not self._keep(robot, name, packed):
            return
        self._history.setdefault(robot, History()).add(name, payload, now)

    def passed(self, sender: str, receiver: str, count: int) -> None:
        """Set how many messages have passed between two robots so far."""
        hop = f"{sender}>{receiver}"
        if hop in self._hops or len(self._hops) < MAX_HOPS:
            self._hops[hop] = count

    def put(self, robot: str, topic: str, value: object, now: float) -> None:
        """Take a decoded sample, which gets no history."""
        self._now = now
        if self._fits(robot, topic, value) and self._keep(robot, topic, value):
            self._read(robot, topic, value, now)

    def refuse(self, robot: str, what: str, why: object) -> None:
        """Count something that a robot has said and that is dropped. The first time, tell of it with the reason."""
        self.refused += 1
        if (robot, what) not in self._named and len(self._named) < MAX_TOPICS:
            self._named.add((robot, what))
            self.note(self._now, robot, "warning", f"{what} is left out, and whatever is like it: {why}")

    def _keep(self, robot: str, topic: str, value: object) -> bool:
        """Keep a value as the newest of its key. Return whether there was room for it."""
        topics = self._topics.setdefault(robot, {})
        size = self._sizes[robot] + _size(value) - _size(topics.get(topic, (0, None))[1])
        if size > MAX_SIZE or (topic not in topics and len(topics) >= MAX_TOPICS):
            self.refused += 1
            return False
        self.version += 1
        topics[topic] = self.version, value
        self._sizes[robot] = size
        return True

    def _open(self, robot: str, topic: str, value: object) -> object:
        """Decode a sample, to `_NOTHING` where it is no message. This is done when somebody looks, since most samples
        are replaced before."""
        return self.values(robot, [(topic, value)]).get(topic, _NOTHING)

    def values(
        self, robot: str, samples: Iterable[tuple[str, object]], lock: AbstractContextManager[object] = _NO_LOCK
    ) -> dict[str, object]:
        """Decode samples of a robot by topic, without those that are no messages. `lock` is the lock around this
        picture where the caller does not hold it: decoding takes long where a robot says much."""
        found: dict[str, object] = {}
        for topic, sample in samples:
            try:
                value = sample.decode(topic) if isinstance(sample, _Packed) else sample
            except PayloadError as error:
                with lock:
                    if _kind(topic) is None:
                        self.refused += 1  # these are an app's own bytes
                    else:
                        self.refuse(robot, topic, error)
            else:
                if value is not _NOTHING:
                    found[topic] = value
        return found

    def _fits(self, robot: str, topic: str, message: object) -> bool:
        """Return whether a decoded message has the types of its key, as far as it goes."""
        try:
            _check(topic, message)
        except PayloadError as error:
            self.refuse(robot, topic, error)
            return False
        return True

    def _read(self, robot: str, topic: str, value: object, now: float) -> None:
        """Note what a person should read."""
        told = self._told.setdefault(robot, {})
        for level, said, about in news(topic, value):
            text, subject = printable(said), printable(about)
            before = told.get(subject)
            if before != text and (before is not None or len(told) < MAX_SUBJECTS):
                told[subject] = text
                if before is not None or level != "info":
                    self.note(now, robot, level, text)

    def alive(self, robot: str, service: str, there: bool, now: float) -> None:
        """Note that a service's process has come or gone."""
        services = self._alive.setdefault(robot, {})
        before = services.get(service)
        if before == there or (before is None and len(services) >= MAX_SERVICES):
            return
        services[service] = there
        self.version += 1
        if before is not None:
            status = self.newest(robot, f"{service}/status")
            ended = service.startswith("app/") and isinstance(status, dict) and status.get("state") == "stopping"
            level = "info" if there or ended else "error"
            self.note(now, robot, level, f"{service} is {'back' if there else 'gone'}")

    def services(self) -> dict[str, dict[str, bool]]:
        """Return by robot which services have been there, and whether they are now."""
        return self._alive

    def topics(self, robot: str) -> tuple[str, ...]:
        """Return the keys of a robot of which there is a sample."""
        return tuple(self._topics.get(robot, ()))

    def newest(self, robot: str, topic: str) -> object:
        """Return the newest value of a key; None where there is none."""
        value = self._open(robot, topic, self._topics.get(robot, {}).get(topic, (0, None))[1])
        return None if value is _NOTHING else value

    def versioned(self, robot: str, topic: str) -> tuple[object, int]:
        """Return the newest value of a key, and the version of the picture with which the value came."""
        return self.newest(robot, topic), self._topics.get(robot, {}).get(topic, (0, None))[0]

    def since(self, robot: str, moved: int, rest: int | None) -> list[tuple[str, object]]:
        """Return topics and samples of a robot, for `values`: those of what moves (`AT_ONCE`) newer than the version
        `moved`, all others newer than `rest` (None: none of them)."""
        topics = self._topics.get(robot, {})
        at_once = AT_ONCE | {pose_topic(topics)}
        entries = topics if rest is not None else {topic: topics[topic] for topic in at_once if topic in topics}
        return [
            (topic, sample)
            for topic, (number, sample) in entries.items()
            if number > (moved if topic in at_once else rest or 0)
        ]

    def events_since(self, number: int) -> list[Event]:
        """Return the events behind a number, oldest first."""
        return [event for event in self.events if event.number > number]

    def hops(self) -> dict[str, int]:
        """Return the numbers of messages that have passed so far, by `sender>receiver`."""
        return dict(self._hops)

    def history(
        self, robot: str, topic: str, most: int | None = None, since: float = -math.inf, until: float = math.inf
    ) -> Iterator[tuple[float, object]]:
        """Return the values of a key in the last two minutes, from `since` to `until` s, oldest first. Where there are
        more than `most`, each n-th of them and the newest. They are decoded only when somebody goes through them."""
        rows = self._history[robot].rows(topic) if robot in self._history else ()
        packed = [row for row in rows if since <= row[0] <= until]
        step = 1 if most is None else -(-len(packed) // most) or 1
        return _decoded(topic, packed[::-1][::step][::-1])

    @property
    def robots(self) -> list[str]:
        """Return the names of the robots that have said something."""
        return sorted(self._topics)

    def look(self, robot: str, t: float) -> list[tuple[str, object]]:
        """Return topics and samples of a robot, for `values`, as they were at an instant of the last two minutes: at
        most `MAX_SIZE` bytes."""
        found: list[tuple[str, object]] = []
        size = 0
        for topic, payload in self._history[robot].at(t) if robot in self._history else ():
            size += len(payload)
            if size <= MAX_SIZE:
                found.append((topic, _Packed(payload)))
        return found

    def trail(self, robot: str, seconds: float, now: float) -> Iterator[tuple[float, float]]:
        """Return the way that a robot has come until `now`, m: the true one where there is one."""
        topic = pose_topic(self.topics(robot))
        return track(self.history(robot, topic, since=now - seconds, until=now), now - seconds)

    def note(self, now: float, robot: str, level: str, text: str) -> None:
        """Add a line to what has happened."""
        self._numbered += 1
        self.version += 1
        self.events.append(Event(self._numbered, now, robot, level, printable(text)))


@lru_cache(4096)
def _kind(topic: str) -> type | None:
    """Return the message type of a topic; None where the topic is none of ours."""
    try:
        return type_of(f"swarm/r/{topic}")
    except PayloadError:
        return None


def _check(topic: str, message: object) -> None:
    if (kind := _kind(topic)) is not None:
        check_fields(kind, message)


def _message(topic: str, payload: bytes) -> object:
    """Decode a sample. Raises `PayloadError`."""
    value = unpack(payload)
    if (parts := _parts(value)) > MAX_PARTS:
        raise PayloadError(f"{parts} values or more in one message: the page takes {MAX_PARTS}")
    message = json_value(value, MAX_BYTES)
    _check(topic, message)
    return message


def _decoded(topic: str, rows: list[tuple[float, bytes]]) -> Iterator[tuple[float, object]]:
    for t, payload in rows:
        with contextlib.suppress(PayloadError):
            yield t, _message(topic, payload)


def _parts(value: object) -> int:
    """Count the values in a decoded message. The count ends soon above `MAX_PARTS`."""
    parts, waiting = 0, [value]
    while waiting and parts <= MAX_PARTS:
        each = waiting.pop()
        inner = each.values() if isinstance(each, dict) else each if isinstance(each, list | tuple) else ()
        parts += len(inner)
        waiting += inner
    return parts


def _size(value: object) -> int:
    """Return the number of bytes that a robot has sent for a value."""
    return len(value.payload) if isinstance(value, _Packed) else 0


def pose_topic(topics: Container[str]) -> str:
    """Return which of a robot's topics tells its pose: the true one where it is known, as in a simulation."""
    return "sim/truth" if "sim/truth" in topics else "dwm/pose"


def track(history: Iterable[tuple[float, object]], since: float) -> Iterator[tuple[float, float]]:
    """Yield a robot's places since a time, m, by the values of a key with `x` and `y`."""
    for t, value in history:
        if t >= since and isinstance(value, dict):
            x, y = value.get("x"), value.get("y")
            if is_number(x) and is_number(y):
                yield float(x), float(y)
