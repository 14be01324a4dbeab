"""The ways of sending that are measured. Each asks the mesh of one robot over its bus, as apps do."""

import contextlib
import itertools
import queue
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

from swarm import clock
from swarm.app.overlays import Handle, Overlays
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError
from swarm.messages import Echo, EchoRequest, Flooded, Sent
from swarm.messages.codec import decoded
from swarm.messages.keys import key
from swarm.onboard.measure.figures import Figures, of_bursts, of_times

PATIENCE = 5.0
"""Seconds to wait for an answer, beyond what the payload takes at `SLOWEST`."""

SLOWEST = 5000.0
"""Slowest way of sending for which an answer is waited for, bytes/s."""

BURST = 64 * 1024
"""Bytes of a burst that measures throughput, where a single message is not longer."""

AT_ONCE = 48
"""Messages of a burst at most: fewer than confirmed floods may be under way."""

APP = "measure"
"""Name of an app under which messages travel: nobody listens to them, so only the meshes are measured."""


Look = Callable[[int, int], None]
"""Called before each message or burst with how many are done, and how many there are."""


class Sender(ABC):
    """One way of sending. `LocalError` where the mesh refuses a message, with its reason."""

    both_ways = False
    """Whether the answer of `one` is as long as the message."""

    @abstractmethod
    def one(self, size: int) -> float | None:
        """Send one message and return the s until its answer; None where that did not come."""

    @abstractmethod
    def many(self, size: int, count: int) -> list[float]:
        """Send messages that follow each other. Return the times at which they were answered, s."""

    def rtt(self, sizes: Sequence[int], count: int, look: Look) -> tuple[Figures, ...]:
        """Send `count` messages of each size, the sizes in turn, so that what changes meanwhile changes all alike."""
        found: dict[int, list[float]] = {size: [] for size in sizes}
        for turn in range(count):
            for place, size in enumerate(sizes):
                look(turn * len(sizes) + place, count * len(sizes))
                if (time := self.one(size)) is not None:
                    found[size].append(time)
        return tuple(of_times(size, times, count, both_ways=self.both_ways) for size, times in found.items())

    def throughput(self, sizes: Sequence[int], count: int, look: Look) -> tuple[Figures, ...]:
        """Send `count` bursts of each size."""
        found = []
        for place, size in enumerate(sizes):
            at_once = max(2, min(AT_ONCE, BURST // size))
            bursts = []
            for turn in range(count):
                look(place * count + turn, count * len(sizes))
                bursts.append(self.many(size, at_once))
            found.append(of_bursts(size, bursts, at_once))
        return tuple(found)


class Pings(Sender):
    """Pings between the meshes of two neighbours (`mesh/set/echo`): they take the way of `neighbours` messages."""

    both_ways = True

    def __init__(self, bus: Bus, robot: str, peer: str, priority: str | None) -> None:
        self._bus = bus
        self._peer = peer
        self._priority = priority
        self._request_key = key(robot, "mesh", "set", "echo")
        self._echoes: queue.SimpleQueue[Echo] = queue.SimpleQueue()
        # Who measures at the same time has other numbers.
        self._sequence = itertools.count(int(clock.wall() * 1e6))
        bus.subscribe(key(robot, "mesh", "echo"), decoded(Echo, self._echoes.put))

    def one(self, size: int) -> float | None:
        """Send one ping that is answered by as many bytes; return its round trip in s."""
        answers = self._ping(size, self._priority or "sync", count=1, short=False)
        return answers[0].rtt if answers else None

    def many(self, size: int, count: int) -> list[float]:
        """Send pings at once, which have short answers."""
        return [echo.t for echo in self._ping(size, self._priority or "bulk", count=count, short=True)]

    def _ping(self, size: int, priority: str, *, count: int, short: bool) -> list[Echo]:
        sequence = next(self._sequence)
        self._bus.publish(self._request_key, EchoRequest(self._peer, sequence, size, count, priority, short))
        answers: list[Echo] = []
        end = clock.now() + _patience(size * count)
        while len(answers) < count and (left := end - clock.now()) > 0:
            with contextlib.suppress(queue.Empty):
                echo = self._echoes.get(timeout=left)
                if echo.sequence == sequence:
                    if echo.rtt is None:
                        raise LocalError(echo.reason)
                    answers.append(echo)
        return answers


class _Messages(Sender):
    """Messages that apps send through the client of the overlays. The time runs from the request until the own mesh
    has the other end's confirmation, so it includes one crossing of the own bus."""

    def __init__(self, bus: Bus, robot: str, priority: str | None) -> None:
        self._overlays = Overlays(bus, robot, APP)
        self._priority = priority

    def one(self, size: int) -> float | None:
        """Send one message and return the s until its confirmation."""
        began = clock.now()
        answered = self._answered(self._send(size, self._priority or "sync"), began + _patience(size))
        return None if answered is None else answered - began

    def many(self, size: int, count: int) -> list[float]:
        """Send messages at once, and wait for their confirmations."""
        end = clock.now() + _patience(size * count)
        handles = [self._send(size, self._priority or "bulk") for _ in range(count)]
        answers = [self._answered(handle, end) for handle in handles]
        return [answered for answered in answers if answered is not None]

    @abstractmethod
    def _send(self, size: int, priority: str) -> Handle[Any]:
        """Ask for one message."""

    @abstractmethod
    def _succeeded(self, answer: Any) -> bool:
        """Return whether a message arrived. Raises `LocalError` where it could not be sent."""

    def _answered(self, handle: Handle[Any], end: float) -> float | None:
        try:
            answer = handle.result(max(0.0, end - clock.now()))
        except TimeoutError:
            return None
        return answer.t if self._succeeded(answer) else None


class UnicastMessages(_Messages):
    """Messages to one robot, over any number of links."""

    def __init__(self, bus: Bus, robot: str, to: str, priority: str | None) -> None:
        super().__init__(bus, robot, priority)
        self._to = to

    def _send(self, size: int, priority: str) -> Handle[Sent]:
        return self._overlays.send(self._to, bytes(size), priority=priority, timeout=_patience(size))

    def _succeeded(self, answer: Sent) -> bool:
        if not answer.delivered and "no answer" not in answer.problem:
            raise LocalError(f"{self._to}: {answer.problem}")
        return answer.delivered


class Floods(_Messages):
    """Messages to all robots; each ends when the echo says that all have it."""

    def _send(self, size: int, priority: str) -> Handle[Flooded]:
        return self._overlays.flood(bytes(size), priority=priority)

    def _succeeded(self, answer: Flooded) -> bool:
        if not answer.complete and not answer.robots:
            raise LocalError(f"flood: {answer.problem}")
        return answer.complete


def _patience(size: int) -> float:
    return PATIENCE + size / SLOWEST
