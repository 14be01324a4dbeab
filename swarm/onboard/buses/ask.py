"""Questions to services whose buses can be reached: answers are collected, and what is not answered is asked again."""

import contextlib
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError
from swarm.messages import GraphRobot, MeshGraph
from swarm.messages.codec import decoded
from swarm.messages.keys import is_name, key

PATIENCE = 3.0
"""Seconds to wait for a bus that is not there yet, and for the answer of a service."""

ROUND = 0.3
"""Seconds between two questions, and until a request without an answer is repeated."""

AWAY = ("left", "gone", "never")

T = TypeVar("T")


class _Ticketed(Protocol):
    @property
    def ticket(self) -> str: ...


A = TypeVar("A", bound=_Ticketed)


def new_ticket() -> str:
    """Return a name for a request that no other request has."""
    return f"{os.getpid()}-{os.urandom(4).hex()}"


class Answers(Generic[T]):
    """The newest answer of each robot to one question."""

    def __init__(self, buses: Mapping[str, Bus], kind: type[T], service: str, topic: str) -> None:
        """`kind`: type of the answer; `service` and `topic`: where it is asked for."""
        self.buses = buses
        self._kind, self._service, self._topic = kind, service, topic
        self._changed = threading.Condition()
        self.newest: dict[str, T] = {}

    def wait(self, seconds: float, enough: Callable[[], bool], order: Callable[[], None] | None = None) -> bool:
        """Give the order and ask all robots, again and again until there is enough or the time is over.

        Returns whether there is enough.
        """
        end = clock.now() + seconds
        while not enough() and clock.now() < end:
            if order is not None:
                order()
            for name, bus in self.buses.items():
                bus.ask(key(name, self._service, self._topic), decoded(self._kind, partial(self._take, name)))
            with self._changed:
                self._changed.wait_for(enough, ROUND)  # an answer is no reason to ask at once
        return enough()

    def _take(self, name: str, answer: T) -> None:
        with self._changed:
            self.newest[name] = answer
            self._changed.notify_all()


def request(
    buses: Mapping[str, Bus],
    requests: Mapping[str, _Ticketed],
    kind: type[A],
    service: str,
    topic: str,
    seconds: float,
    *,
    answered: str = "",
    every: float = ROUND,
) -> dict[str, A]:
    """Send each robot its request at SERVICE/set/TOPIC, again each `every` s until it is answered.

    The answer comes at SERVICE/TOPIC_set, or at SERVICE/`answered`. Returns those that have come within `seconds`, by
    robot.
    """
    answers: dict[str, A] = {}
    changed = threading.Condition()

    def take(robot: str, answer: A) -> None:
        if answer.ticket == requests[robot].ticket:
            with changed:
                answers.setdefault(robot, answer)
                changed.notify_all()

    for robot in requests:
        buses[robot].subscribe(key(robot, service, answered or f"{topic}_set"), decoded(kind, partial(take, robot)))
    end = clock.now() + seconds
    with changed:
        while len(answers) < len(requests) and clock.now() < end:
            for robot in requests.keys() - answers.keys():
                buses[robot].publish(key(robot, service, "set", topic), requests[robot], urgent=True)
            changed.wait_for(lambda: len(answers) == len(requests), min(every, max(0.0, end - clock.now())))
    return answers


def newest(directory: Path, robot: str, kind: type[T], service: str, topic: str, seconds: float) -> T | None:
    """Listen until a robot has published a message of this type; None where it has not within `seconds`."""
    found: list[T] = []
    heard = threading.Event()

    def take(message: T) -> None:
        found.append(message)
        heard.set()

    with Bus.of(directory) as bus:
        bus.subscribe(key(robot, service, topic), decoded(kind, take))
        heard.wait(seconds)
    return found[-1] if found else None


class Views:
    """The view of the whole swarm (`mesh/graph`) of each mesh that was asked."""

    def __init__(self) -> None:
        self.robots: dict[str, dict[str, GraphRobot]] = {}
        """What robots report, by the robot that was asked and the robot that the report is about."""
        self.changed = threading.Condition()

    def ask(self, name: str, bus: Bus, timeout_s: float) -> None:
        """Ask one robot's mesh; where it does not answer nothing happens."""
        self._page(name, bus, timeout_s, "", {})

    def _page(self, name: str, bus: Bus, timeout_s: float, after: str, found: dict[str, GraphRobot]) -> None:
        def take(graph: MeshGraph) -> None:
            found.update((each.robot, each) for each in graph.robots if is_name(each.robot))
            if graph.more and graph.robots and graph.robots[-1].robot > after:  # or it would never end
                self._page(name, bus, timeout_s, graph.robots[-1].robot, found)
                return
            with self.changed:
                self.robots[name] = found
                self.changed.notify_all()

        parameters = {"after": after} if after else {}
        bus.ask(key(name, "mesh", "graph"), decoded(MeshGraph, take), timeout_s=timeout_s, **parameters)

    def best(self) -> dict[str, GraphRobot]:
        """Return one entry for each robot: its own word where it was asked, else that of one who has a way to it."""
        found: dict[str, GraphRobot] = {}
        with self.changed:
            views = [dict(view) for view in self.robots.values()]
        for view in views:
            for name, entry in view.items():
                known = found.get(name)
                if known is None or _rank(entry) < _rank(known):
                    found[name] = entry
        return dict(sorted(found.items()))


@contextlib.contextmanager
def opened(directories: Mapping[str, Path]) -> Iterator[dict[str, Bus]]:
    """Open the buses of these robots, those that are there; `LocalError` where none is."""
    with contextlib.ExitStack() as stack:
        # All are opened at once, so that several which are not there cost the patience for one.
        buses = {name: stack.enter_context(Bus.of(directory)) for name, directory in directories.items()}
        some = threading.Event()
        for bus in buses.values():
            bus.on_change(lambda up: some.set() if up else None)
        if not some.wait(PATIENCE):
            raise LocalError(f"no bus is there: {', '.join(map(str, directories.values()))}; is the robot switched on?")
        yield buses


def _rank(entry: GraphRobot) -> int:
    """Return a rank that is the lower the better a robot is known."""
    return {"self": 0, "here": 1}.get(entry.state, 2)
