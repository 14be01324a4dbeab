"""Two sessions joined by a link of a certain latency and bandwidth, under virtual time."""

import math
import random
from collections import Counter

from timed_world import TimedWorld

from services.mesh.core.link import Received
from services.mesh.core.link.calls import Local
from services.mesh.core.link.clock import ClockSync
from services.mesh.core.link.session import Session
from services.mesh.links.radio_model import AirModel, DelayLine

MIB = 1024 * 1024


class Side:
    """One end: its session, the socket's queue before it, and what has come."""

    def __init__(self, name: str, peer: str, dialled: bool, line: DelayLine) -> None:
        self.counters: Counter[str] = Counter()
        local = Local(name, "lab", 1, insecure=True, dials={peer: dialled}, robots=frozenset((name, peer)))
        self.session = Session(
            local,
            bytes(16),
            0.0,
            dialled=peer if dialled else None,
            admit=lambda *_: True,
            clock=ClockSync(name, 1, frozenset((name, peer))),
            counters=self.counters,
        )
        self.line = line
        self.socket: list[bytes] = []
        self.inbox: list[tuple[float, Received]] = []
        self.written = 0
        self.wakes_at = -1.0
        self.resumes = 0.0


class Link(TimedWorld):
    """The link. `sndbuf` bytes fit between a session and the air, as in the kernel's socket."""

    def __init__(
        self,
        *,
        latency: float = 0.03,
        jitter: float = 0.0,
        bandwidth: float | None = 78_000.0,
        sndbuf: int = 50_000,
        seed: int = 1,
    ) -> None:
        super().__init__()
        model = AirModel(latency, jitter, bandwidth)
        draw = random.Random(seed)
        self.sndbuf = sndbuf
        self.a = Side("a", "b", True, DelayLine(model, draw))
        self.b = Side("b", "a", False, DelayLine(model, draw))
        self._timers: dict[Side, float | None] = {self.a: None, self.b: None}
        for side in (self.a, self.b):
            self.work(side)
        self.run(1.0)
        assert self.a.session.is_up
        assert self.b.session.is_up

    def other(self, side: Side) -> Side:
        return self.b if side is self.a else self.a

    def send(self, side: Side, priority: int, key: str, payload: bytes, latest: bool = False) -> bool:
        taken = side.session.queue.push(priority, key, payload, latest=latest)
        self.work(side)
        return taken

    def work(self, side: Side) -> None:
        """Move what can be moved: from the session into the socket, from there onto the air."""
        session = side.session
        for event in session.events():
            if isinstance(event, Received):
                side.inbox.append((self.now, event))
        while sum(map(len, side.socket)) < self.sndbuf and (data := session.data_to_send(self.now, 4096)):
            side.socket.append(data)
            side.written += len(data)
        line, receiver = self.other(side).line, self.other(side)
        # The air takes the bytes at its own pace: each write when those before it have passed.
        if self.now >= side.wakes_at:
            side.wakes_at = -1.0
        while side.socket and line.free_at <= self.now:
            data = side.socket.pop(0)
            line.push(data, self.now)
            self.at(line._last_arrival, lambda data=data: self._arrive(receiver, data))  # type: ignore[misc]
        if side.socket and side.wakes_at < self.now:
            side.wakes_at = line.free_at
            self.at(line.free_at, lambda: self.work(side))
        if self.now < (at := session.resumes) < math.inf and at != side.resumes:
            side.resumes = at
            self.at(at, lambda: self.work(side))
        deadline = session.deadline
        if deadline < math.inf and deadline != self._timers[side]:
            self._timers[side] = deadline
            self.at(max(deadline, self.now), lambda: self._timer(side))

    def _timer(self, side: Side) -> None:
        side.session.handle_timer(self.now)
        self.work(side)

    def _arrive(self, side: Side, data: bytes) -> None:
        side.session.receive(data, self.now)
        self.work(side)


def arrived(side: Side, key: str) -> list[tuple[float, bytes]]:
    return [(time, event.payload) for time, event in side.inbox if event.key == key]
