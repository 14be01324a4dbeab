"""What robots say to each other over the slot radio or emulated links, in place of our services: the thesis' round-trip
test, its original lockstep, and the least that any lockstep can do. Seeded, in virtual time."""

import random
import statistics
from collections.abc import Callable, Generator, Iterable, Sequence
from functools import partial
from typing import Any

from sim.slots.parameters import SlotParameters
from sim.slots.radio import SlotRadio
from sim.virtual.events import EventQueue

Edges = Sequence[tuple[str, str]]
"""Links; the first robot of each is the central."""

SMALL = 9
"""Bytes of a message of the original."""
VALUE, HEAD = 24, 48
"""Bytes that ours need for each value, and besides."""
WARM_UP = 0.15


class FixedLinks:
    """Emulated links that take so many seconds one way, in place of the slot radio."""

    def __init__(self, time: EventQueue, latency: float) -> None:
        self._time, self._latency = time, latency

    def connect(self, a: str, b: str) -> None:
        """Links are always up."""

    def send(self, link: None, sender: str, size: int, heard: Callable[[], None]) -> None:
        """Call `heard` when the message arrives."""
        self._time.at(self._time.now + self._latency, heard)


class Pattern:
    """Robots on a radio, and when each began its iterations.

    `air`: parameters of the slot radio, or the one-way latency of emulated links in seconds.
    """

    def __init__(self, links: Edges, air: SlotParameters | float, seed: object) -> None:
        self.time = EventQueue()
        self.random = random.Random(f"{seed} pattern")
        self.names = sorted({name for link in links for name in link})
        self.radio: Any = (
            FixedLinks(self.time, air)
            if isinstance(air, float)
            else SlotRadio(self.time, self.names, air, random.Random(f"{seed} slots"))
        )
        self.links = {frozenset(link): self.radio.connect(*link) for link in links}
        self.times: dict[str, list[float]] = {name: [] for name in self.names}

    def say(self, sender: str, to: str, size: int, heard: Callable[[], None]) -> None:
        """Send a message; `heard()` is called where it arrives."""
        self.radio.send(self.links[frozenset((sender, to))], sender, size, heard)

    def after(self, seconds: float, call: Callable[[], object]) -> None:
        """Call later."""
        self.time.at(self.time.now + seconds, call)

    def paced(self, iterations: int, turn: float = 10.0) -> float:
        """Run until each robot has had so many iterations, `turn` s at a time, and return s an iteration."""
        while min(map(len, self.times.values())) < iterations:
            self.time.run(self.time.now + turn)
        return pace(self.times.values())


def pace(times: Iterable[Sequence[float]]) -> float:
    """s an iteration, over robots' times of iterations but for the first ones."""
    spans = []
    for each in times:
        first = max(1, int(len(each) * WARM_UP))
        spans.append((each[-1] - each[first]) / (len(each) - 1 - first))
    return statistics.fmean(spans)


def neighbours(edges: Edges) -> dict[str, tuple[str, ...]]:
    """Of each robot of a graph."""
    near: dict[str, list[str]] = {}
    for a, b in edges:
        near.setdefault(a, []).append(b)
        near.setdefault(b, []).append(a)
    return {name: tuple(sorted(others)) for name, others in sorted(near.items())}


class Original(Pattern):
    """The thesis' lockstep: a mailbox, data and acknowledgement, a sleep while something lacks (`poll` s), and DELAY
    twice an iteration. A message has to wait up to `lock` s for the interpreter of who receives it."""

    def __init__(
        self, links: Edges, air: SlotParameters | float, seed: object, *, poll: float, delay: float = 0.0, lock: float
    ) -> None:
        super().__init__(links, air, seed)
        self._poll, self._delay, self._lock = poll, delay, lock
        self._near = neighbours(links)
        self._box: dict[tuple[str, str], tuple[int, int]] = {}
        """The newest data and acknowledgement, by receiver and sender."""
        for name in self.names:
            self.after(0.3 * self.random.random(), partial(self._step, self._robot(name)))

    def _step(self, robot: Generator[float]) -> None:
        self.after(next(robot), partial(self._step, robot))

    def _say_to_all(self, name: str, data: int, acknowledged: int) -> None:
        for peer in self._near[name]:
            self.say(name, peer, SMALL, partial(self._heard, (peer, name), (data, acknowledged)))

    def _heard(self, way: tuple[str, str], message: tuple[int, int]) -> None:
        self.after(self._lock * self.random.random(), partial(self._box.__setitem__, way, message))

    def _pause(self, seconds: float) -> float:
        return seconds + 0.0002 + 0.001 * self.random.random()

    def _robot(self, name: str) -> Generator[float]:
        box, k = self._box, 0
        ways = [(name, peer) for peer in self._near[name]]
        while True:
            while k and any(box.get(way, (0, 0))[1] != k for way in ways):
                yield self._pause(self._poll)
            self._say_to_all(name, k, k)
            while any(box.get(way, (-1, 0))[0] != k for way in ways):
                yield self._pause(self._poll)
            yield self._pause(self._delay)
            self._say_to_all(name, k, k + 1)
            self.times[name].append(self.time.now)
            yield self._pause(self._delay)
            k += 1


class Bundled(Pattern):
    """Lockstep of a graph in one piconet: each robot tells the hub, the central, and the hub tells each in one message
    all that it needs of the others."""

    def __init__(self, edges: Edges, parameters: SlotParameters, seed: object, *, compute: float) -> None:
        near = neighbours(edges)
        self._hub = max(near, key=lambda name: len(near[name]))
        super().__init__([(self._hub, name) for name in near if name != self._hub], parameters, seed)
        self._near, self._compute = near, compute
        self._at, self._has = dict.fromkeys(near, -1), dict.fromkeys(near, -1)
        """At which iteration each robot is, and of which it has all that it needs."""
        self._known: dict[int, set[str]] = {}
        """At the hub: whose values of an iteration are there."""
        for name in self.names:
            self.after(0.3 * self.random.random(), partial(self._begin, name, 0))

    def _begin(self, name: str, k: int) -> None:
        self._at[name] = k
        self.times[name].append(self.time.now)
        if name == self._hub:
            self._know(name, k)
        else:
            self.say(name, self._hub, HEAD + VALUE, partial(self._know, name, k))
            self._told(name, self._has[name])

    def _know(self, name: str, k: int) -> None:
        known = self._known.setdefault(k, set())
        known.add(name)
        for peer, needed in self._near.items():
            if peer != self._hub and name in needed and known.issuperset(needed):
                self.say(self._hub, peer, HEAD + VALUE * len(needed), partial(self._told, peer, k))
        if known.issuperset((self._hub, *self._near[self._hub])):
            self._told(self._hub, k)
        self._known.pop(k - 3, None)

    def _told(self, name: str, k: int) -> None:
        self._has[name] = k
        if self._at[name] == k:
            wait = self._compute * (0.5 + self.random.random())
            self.after(wait, partial(self._next, name, k))

    def _next(self, name: str, k: int) -> None:
        if self._at[name] == k:
            self._begin(name, k + 1)


def round_trips(size: int, parameters: SlotParameters, count: int, *, lock: float) -> list[float]:
    """The thesis' test: a message every 3 s, sent back by the other end. Both ends are busy programs: each message
    waits `lock` s, give or take half of it, for the interpreter. In s."""
    pair = Pattern([("r1", "r0")], parameters, size)
    found: list[float] = []

    def wait() -> float:
        return lock * (0.5 + pair.random.random())

    def back(began: float) -> None:
        pair.after(wait(), lambda: pair.say("r1", "r0", size, partial(home, began)))

    def home(began: float) -> None:
        pair.after(wait(), lambda: found.append(pair.time.now - began))

    for number in range(1, count + 1):
        at = 3.0 * number + 0.1 * pair.random.random()
        pair.time.at(at, lambda at=at: pair.say("r0", "r1", size, partial(back, at)))
    pair.time.run(3.0 * count + 5.0)
    return found
