"""One lockstep of an app on one robot: the author's steps, the lockstep core, and what both mean for the run.

An app has one strand, or one for each of its channels. No IO, no clock, no thread: a process (`services.apps.worker`)
and virtual time drive the same object. Two things happen to a strand, perhaps in two threads: messages and timers,
which take no time, and the app's code, which may take long. So `begin` and `compute` alone touch the app, and the
driver holds a lock of its own around the rest.
"""

import struct
from collections.abc import Iterable, Mapping
from typing import Protocol

from swarm.core.lockstep import Action, Channel, Compute, Fault, Finished, Lockstep, Waiting
from swarm.core.lockstep_frames import Snapshot
from swarm.messages import Measurement

ALONE = 0.03
"""s of an iteration of a robot without neighbours, who has nobody to wait for."""

_STAMP = struct.Struct("<d")  # before the private fields in a snapshot: when its state was computed


class Program(Protocol):
    """The author's app between packed states: `services.apps.runner.Runner`."""

    k: int

    @property
    def size(self) -> int:
        """Bytes of one packed state."""

    def start(self, measurement: Measurement | None) -> tuple[bytes, bytes]:
        """The first state, packed: shared, private."""

    def step(
        self, k: int, own: bytes, values: Mapping[str, bytes], measurement: Measurement | None
    ) -> tuple[bytes, bytes]:
        """x(k+1), packed: shared, private."""

    def restore(self, k: int, own: bytes, private: bytes) -> None:
        """Be again where a snapshot was taken."""


class Strand:
    """What a driver asks, tells and carries out; see the module's text for its two sides."""

    def __init__(
        self, me: str, neighbours: Iterable[str], channel: Channel, program: Program, last: int | None = None
    ) -> None:
        """`last`: the last iteration, if there is one."""
        self.channel = channel
        self.phase = "starting"
        """starting, running, done or fault."""
        self.reason = ""
        """Of a fault."""
        self.waiting: tuple[str, ...] = ()
        """Robots whose value has been missing for a while."""
        self.computed_at = 0.0
        """When the newest state was computed."""
        self.lockstep = Lockstep(me, neighbours, channel, program.size, last=last)
        self._program = program

    @property
    def k(self) -> int:
        """The iteration it is at."""
        return max(self.lockstep.k, 0)

    @property
    def begun(self) -> bool:
        """Whether there is a first state."""
        return self.lockstep.k >= 0

    def saved(self, data: bytes | None) -> Snapshot | None:
        """What an earlier process of this run has left behind; None for nothing, or another run's."""
        if data is None:
            return None
        snapshot = Snapshot.decode(data)
        return snapshot if snapshot.run == self.channel.run else None

    # The app's side

    def begin(self, saved: Snapshot | None, measurement: Measurement | None, now: float) -> None:
        """Go on from a snapshot, or let the app set its first state. What the app raises is `AppError`."""
        self.phase = "running"
        if saved is not None:
            private = self.lockstep.resume(saved.encode(), now)
            (self.computed_at,) = _STAMP.unpack_from(private)
            self._program.restore(saved.k, saved.value, private[_STAMP.size :])
        else:
            own, private = self._program.start(measurement)
            self.computed_at = now
            self.lockstep.start(own, now, _STAMP.pack(now) + private)

    def compute(self, todo: Compute, measurement: Measurement | None) -> tuple[bytes, bytes]:
        """Run the app's step; what it gives goes to `computed`."""
        return self._program.step(todo.k, todo.own, todo.values, measurement)

    # The other side

    def computed(self, answer: tuple[bytes, bytes], now: float) -> None:
        """Go on with what `compute` gave."""
        own, private = answer
        self.computed_at = now
        self.lockstep.computed(own, _STAMP.pack(now) + private, now)

    def receive(self, sender: str, channel: Channel, payload: bytes, now: float) -> None:
        """A frame. Before the own start there is no slot for it: its sender is asked again."""
        if self.begun:
            self.lockstep.receive(sender, channel, payload, now)

    def nudge(self, now: float) -> None:
        """The bus or a link came up: ask now for what is missing."""
        if self.begun:
            self.lockstep.nudge(now)
            self.lockstep.handle_timer(now)

    def handle_timer(self, now: float) -> None:
        """Do what is due."""
        self.lockstep.handle_timer(now)

    def next_deadline(self) -> float | None:
        """When `handle_timer` wants to be called."""
        return self.lockstep.next_deadline()

    def actions(self) -> list[Action]:
        """What the driver is to do now, in this order: Compute, Save, Send, and Advanced, Fault, Finished as news."""
        actions = self.lockstep.actions()
        for action in actions:
            match action:
                case Waiting(_, peers):
                    self.waiting = peers
                case Fault(reason):
                    self.fail(reason)
                case Finished():
                    self.phase = "done"
        return actions

    def fail(self, reason: str) -> bool:
        """Compute no more; neighbours still get answers, and the reason can be read. Whether that is news."""
        if self.phase == "fault":
            return False
        self.phase, self.reason = "fault", reason
        return True
