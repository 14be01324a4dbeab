"""The records of an app beside its own states: what its robot's services published meanwhile on the bus.

Poses, LEDs, buttons, the body, links, clock and topology of the mesh, and the messages of this app that came in: what
the pictures of a run need, and no more, since each costs the process some 0.1 ms. Fast keys are thinned out.
"""

import logging
import threading
from collections import deque
from collections.abc import Callable, Collection
from functools import partial
from typing import NamedTuple, Protocol

from swarm.bus.protocol import BusLike, Now
from swarm.bus.throttle import THROTTLED
from swarm.errors import PayloadError
from swarm.messages import Flooded, FloodRequest, Passed, SendRequest, Sent, read
from swarm.messages.codec import MAX_PAYLOAD
from swarm.messages.keys import key

TOPICS = {
    "dwm/pose": 0.0,
    "balancer/state": 0.2,
    "balancer/leds": 0.0,
    "balancer/buttons": 0.0,
    "balancer/fault": 0.0,
    "mesh/links": 0.0,
    "mesh/clock": 1.0,
    "mesh/topology": 2.0,
    "mesh/members": 0.0,
    "mesh/flooded": 0.0,
    "mesh/sent": 0.0,
    "mesh/passed": 0.0,
    "sim/truth": 0.2,
    "sim/target": 0.2,
    "sim/leds": 0.0,
}
"""What is recorded of the robot's own keys, and the least time between two messages of a key, s. Links are told once a
second, and when one comes or goes: such a message left out would show it wrong until the next."""

THROTTLED_TOPICS = ("balancer/state", "sim/truth")
"""Topics of which the throttled copy is recorded."""

EARLY = 0.75
"""A message may come that share of the least time after the one before: clocks of publishers are not even. The next
one after it is due no earlier for that."""

MAX_WAITING = 4096
"""Messages that wait to be looked at; the oldest are lost."""

MAX_BYTES = 2 << 20
"""Bytes of these messages and their keys together, for the same reason."""

MAX_ASKED = 256
"""Requests that are told from their repetitions."""

_log = logging.getLogger("record")


class Takes(Protocol):
    """A function that stores a message."""

    def write(self, topic: str, t: float, message: object, name: str = "") -> None:
        """Record a message at `t`."""


class Asked(NamedTuple):
    """A flood (`to` is empty) or message that this app asked the mesh for, on `.../app/<app>/asked`."""

    t: float
    ticket: str
    to: str
    size: int
    """Bytes of its payload."""

    def fields(self) -> dict[str, object]:
        return self._asdict()


class Heard(NamedTuple):
    """A flood or message of the same app on another robot that has come, on `.../app/<app>/heard`."""

    t: float
    sender: str
    flooded: bool
    size: int

    def fields(self) -> dict[str, object]:
        return self._asdict()


class TopicRecorder:
    """Listens on one robot's bus, and puts what it hears into a recording when told to."""

    def __init__(
        self,
        bus: BusLike,
        robot: str,
        app: str,
        sink: Takes,
        now: Now,
        *,
        topics: Collection[str] = tuple(TOPICS),
    ) -> None:
        """`topics`: which of `TOPICS` are recorded."""
        self._sink = sink
        self._now = now
        self._app = app
        self._prefix = key(robot, f"app/{app}")
        self._lock = threading.Lock()
        """The lock around what waits."""
        self._waiting: deque[tuple[str, bytes, int, float]] = deque()
        """Keys, payloads, their sizes and times. Of a message of another robot's app only the size is kept."""
        self._bytes = 0
        """Bytes of the keys and payloads that wait."""
        self._due: dict[str, float] = {}
        self._asked: deque[str] = deque(maxlen=MAX_ASKED)
        self._least = {key(robot, topic): least for topic, least in TOPICS.items() if topic in topics}
        self.on_sample: Callable[[], None] = lambda: None
        """Called after each message: in virtual time `drain`, as there is no thread that would."""
        self.on_lost: Callable[[int], None] = lambda count: None
        """Called with the number of messages that are lost, as too much waits."""
        of = partial(key, robot)
        throttled = [topic for topic in THROTTLED_TOPICS if topic in topics]
        self._copies = {f"{name}/{THROTTLED}": name for name in map(of, throttled)}
        heard = set(self._least) - set(self._copies.values()) | set(self._copies)
        bus.subscribe(sorted(heard), self._take)
        bus.subscribe([key("*", "app", app, "flood"), key("*", "app", app, "send", robot)], self._take)

    def hear_requests(self, bus: BusLike, robot: str) -> None:
        """Take this app's requests and parameters from the bus, where its session is another one than ours (in virtual
        time)."""

        def take(name: str, payload: bytes) -> None:
            request = read(name, payload)
            if not isinstance(request, FloodRequest | SendRequest) or request.app != self._app:
                return
            if request.ticket not in self._asked:  # else it waits for its answer, and is repeated
                self._asked.append(request.ticket)
                self.asked(request)

        parameters = f"{self._prefix}/parameters"
        self._least[parameters] = 0.0
        bus.subscribe(parameters, self._take)
        bus.subscribe([key(robot, "mesh", "set", "flood"), key(robot, "mesh", "set", "send")], take)

    def asked(self, request: FloodRequest | SendRequest) -> None:
        """This app asks the mesh to carry something."""
        to = request.to if isinstance(request, SendRequest) else ""
        asked = Asked(self._now(), request.ticket, to, len(request.payload))
        self._sink.write(f"{self._prefix}/asked", asked.t, asked.fields(), "swarm.Asked")

    def drain(self) -> None:
        """Record what has come since the last call."""
        while True:
            with self._lock:
                if not self._waiting:
                    return
                name, payload, size, t = self._pop()
            if name in self._least:
                self._record(name, payload, t)
            else:
                _, sender, _, _, kind, *_ = name.split("/")
                heard = Heard(t, sender, kind == "flood", size)
                self._sink.write(f"{self._prefix}/heard", t, heard.fields(), "swarm.Heard")

    def _take(self, name: str, payload: bytes) -> None:
        """Keep a sample for the writer. Zenoh's thread calls this, so nothing is decoded here."""
        t = self._now()
        name = self._copies.get(name, name)
        least, size = self._least.get(name), len(payload)
        if least is None:
            payload = b""
        elif size > MAX_PAYLOAD:  # no message of a service has that many
            return
        if least:
            due = self._due.get(name, t)
            if t < due - (1 - EARLY) * least:
                return
            self._due[name] = max(due, t) + least
        lost = 0
        with self._lock:
            self._waiting.append((name, payload, size, t))
            self._bytes += len(name) + len(payload)
            while len(self._waiting) > MAX_WAITING or self._bytes > MAX_BYTES:
                self._pop()
                lost += 1
        if lost:
            self.on_lost(lost)
        self.on_sample()

    def _pop(self) -> tuple[str, bytes, int, float]:
        """Take out the oldest one; the caller holds the lock."""
        name, payload, size, t = self._waiting.popleft()
        self._bytes -= len(name) + len(payload)
        return name, payload, size, t

    def _record(self, name: str, payload: bytes, t: float) -> None:
        try:
            message = read(name, payload)
        except PayloadError as error:
            _log.debug("not recorded: %s", error)
            return
        if isinstance(message, Flooded | Sent | Passed) and message.app not in ("", self._app):
            return  # of another app; of an answer on its way nobody knows
        self._sink.write(name, getattr(message, "t", t), message)
