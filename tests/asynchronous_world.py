"""Cores of the asynchronous overlay joined in memory, in virtual time: loss, delay, order, hangs and kills as told."""

import math
from collections.abc import Callable, Sequence
from typing import Any

from timed_world import TimedWorld

from swarm.core.asynchronous import Asynchronous, HandlerCall, Publish
from swarm.core.lockstep.frames import Channel

SIZE = 2


class Process:
    """One app process: its state is a count of what it did, two bytes."""

    def __init__(self, world: "World", name: str, incarnation: int, **options: Any) -> None:
        self.world = world
        self.name = name
        self.alive = True
        self.calls: list[tuple[float, HandlerCall]] = []
        self.steps: list[float] = []
        self.seen: list[tuple[str, bytes]] = []
        self.state = bytes(SIZE)
        neighbours = tuple(
            other for other in world.names if abs(world.names.index(other) - world.names.index(name)) == 1
        )
        channel = Channel(7, 0, incarnation, world.versions.get(name, 1))
        self.core = Asynchronous(name, neighbours, channel, SIZE, world.names, **options)
        self.core.begin(world.now)
        self.carry_out()

    def carry_out(self) -> None:
        for action in self.core.actions():
            if isinstance(action, Publish):
                self.world.publish(self, action.data)
                continue
            self.calls.append((self.world.now, action))
            if action.handler == "step":
                self.steps.append(self.world.now)
            self.seen += [(known.name, known.data) for known in self.core.known(self.world.now)]
            self.world.at(
                self.world.now + self.world.handler_time(self.name, action), lambda call=action: self.returned(call)
            )  # type: ignore[misc]
        deadline = self.core.next_deadline()
        if deadline is not None:
            self.world.at(max(self.world.now, deadline), self.tick)

    def returned(self, call: HandlerCall) -> None:
        if self.alive:
            if call.handler == "step":
                self.state = (int.from_bytes(self.state, "little") + 1).to_bytes(SIZE, "little")
            self.core.returned(self.state, self.world.now)
            self.carry_out()

    def tick(self) -> None:
        deadline = self.core.next_deadline()
        if self.alive and deadline is not None and deadline <= self.world.now:
            self.core.handle_timer(self.world.now)
            self.carry_out()

    def do(self, act: Callable[[Asynchronous, float], object]) -> None:
        act(self.core, self.world.now)
        self.carry_out()


class World(TimedWorld):
    """A line of robots. `fate(sender, receiver)` gives a frame's delay in s; None = it is lost."""

    def __init__(
        self,
        count: int,
        fate: Callable[[str, str], float | None] = lambda *_: 0.0,
        handler_time: Callable[[str, HandlerCall], float] = lambda *_: 0.0,
        versions: dict[str, int] | None = None,
    ) -> None:
        super().__init__()
        self.names: Sequence[str] = [f"r{number}" for number in range(count)]
        self.fate = fate
        self.handler_time = handler_time
        self.versions = versions or {}
        self.processes: dict[str, Process] = {}
        self.frames: list[tuple[float, str, bytes]] = []
        self._incarnations = dict.fromkeys(self.names, 0)

    def start(self, name: str, **options: Any) -> Process:
        """Start or restart a process; one of before is dead."""
        if name in self.processes:
            self.processes[name].alive = False
        self._incarnations[name] += 1
        process = self.processes[name] = Process(self, name, self._incarnations[name], **options)
        return process

    def publish(self, sender: Process, data: bytes) -> None:
        self.frames.append((self.now, sender.name, data))
        for name in sender.core.neighbours:
            delay = self.fate(sender.name, name)
            if delay is not None:
                self.at(self.now + delay, lambda name=name: self._deliver(sender, name, data))  # type: ignore[misc]

    def _deliver(self, sender: Process, name: str, data: bytes) -> None:
        receiver = self.processes.get(name)
        if receiver is not None and receiver.alive:
            receiver.do(lambda core, now: core.receive(sender.name, sender.core.channel, data, now))


def never(*_: object) -> float:
    return math.inf
