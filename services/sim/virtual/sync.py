"""The host of a synchronous app under virtual time: lockstep and app as `services.apps.host` joins them, without its
threads and files."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

from services.apps.core.strand import ALONE
from services.apps.runner import Runner
from services.sim.virtual.bus import VirtualBus
from services.sim.virtual.events import EventQueue
from swarm.codec import Value, decode
from swarm.core.lockstep import Advanced, Channel, Compute, Fault, Finished, Lockstep, Send, Waiting
from swarm.errors import AppError, FrameError
from swarm.keys import key
from swarm.messages import Links, Measurement

_NEVER = float("inf")


class Line(NamedTuple):
    """What a run has of one iteration of one robot."""

    k: int
    t: float
    state: dict[str, Value]
    result: dict[str, Value]


class Measurements(Protocol):
    """Where an app's measurements come from."""

    def get(self, k: int, ready: Callable[[Measurement], None]) -> None:
        """Call `ready(measurement)` when that of step k is there."""


class SyncHost:
    """One app on one robot, from the first state to the last iteration."""

    def __init__(
        self,
        name: str,
        robot: str,
        runner: Runner,
        neighbours: tuple[str, ...],
        channel: Channel,
        *,
        last: int | None,
        time: EventQueue,
        bus: VirtualBus,
        measurements: Measurements | None,
        advanced: Callable[["SyncHost", Line], None],
        ended: Callable[["SyncHost"], None],
    ) -> None:
        """`advanced` is called for each iteration, `ended` when the last one is done or the app has failed."""
        self.name = name
        self.robot = robot
        self.waiting: tuple[str, ...] = ()
        """Who is waited for, named as the real host names them."""
        self.fault = ""
        self.runner = runner
        self._time = time
        self._bus = bus
        self._measurements = measurements
        self._advanced = advanced
        self._ended = ended
        self._core = Lockstep(robot, neighbours, channel, runner.schema.size, last=last)
        self._sync = key(robot, f"app/{name}", "sync", channel.text)
        self._senders: dict[str, tuple[str, Channel] | None] = {}
        self._connections: dict[str, int] = {}
        self._timer = _NEVER
        self._computed_at = 0.0
        for peer in (robot, *neighbours):
            bus.subscribe(key(peer, f"app/{name}", "sync", "**"), self._on_sync)
        bus.subscribe(key(robot, "mesh", "links"), self._on_links)

    @property
    def k(self) -> int:
        """The iteration it is at; -1 before the start."""
        return self._core.k

    def start(self) -> None:
        """Let the app begin, as soon as there is a measurement for it where it wants one."""
        if self._measurements is None:
            self._begin(None)
        else:
            self._measurements.get(0, self._begin)

    def _begin(self, measurement: Measurement | None) -> None:
        try:
            own, private = self.runner.start(measurement)
        except AppError as error:
            self._fail(str(error))
            return
        self._computed_at = self._time.now
        self._core.start(own, self._time.now, private)
        self._perform()

    def _on_sync(self, name: str, payload: bytes) -> None:
        known = self._senders.get(name)
        if known is None:
            if (known := self._parsed(name)) is None:
                return
            self._senders[name] = known
        if self._core.k >= 0:  # before the own start there is no slot: the sender is asked again
            self._core.receive(*known, payload, self._time.now)
            self._perform()

    def _parsed(self, name: str) -> tuple[str, Channel] | None:
        """Sender and channel of a frame's key; None where it is for another robot, or is no such key."""
        _, sender, _, _, _, channel, *receiver = name.split("/")
        if receiver and receiver != [self.robot]:
            return None
        try:
            return sender, Channel.parse(channel)
        except FrameError:
            return None

    def _on_links(self, name: str, payload: bytes) -> None:
        links = decode(Links, payload, name).links
        up = {link.peer: link.connection for link in links if link.state == "up"}
        rtts = [link.rtt for link in links if link.rtt is not None]
        if rtts:
            self._core.rtt = max(rtts)
        renewed = any(self._connections.get(peer) != connection for peer, connection in up.items())
        self._connections.update(up)
        if renewed and self._core.k >= 0:
            self._core.nudge(self._time.now)
            self._core.handle_timer(self._time.now)
            self._perform()

    def _compute(self, todo: Compute, measurement: Measurement | None) -> None:
        if self.fault:
            return
        try:
            own, private = self.runner.step(todo.k, todo.own, todo.values, measurement)
        except AppError as error:
            self._fail(str(error))
            return
        self._computed_at = self._time.now
        self._core.computed(own, private, self._time.now)
        self._perform()

    def _do(self, todo: Compute) -> None:
        if self._measurements is not None:
            self._measurements.get(todo.k, lambda measurement: self._compute(todo, measurement))
        elif todo.values:
            self._compute(todo, None)
        else:
            self._time.at(self._time.now + ALONE, self._compute, todo, None)

    def _perform(self) -> None:
        """Carry out what the core wants, in its order."""
        core = self._core
        for action in core.actions():
            if type(action) is Send:
                to = action.to
                self._bus.publish(self._sync if to is None else f"{self._sync}/{to}", action.data, urgent=True)
            elif type(action) is Compute:
                # Not from within: a robot without neighbours would never come back.
                self._time.soon(self._do, action)
            elif type(action) is Advanced:
                try:
                    line = Line(action.k, self._computed_at, self.runner.state(), self.runner.result())
                except AppError as error:
                    self._fail(str(error))
                    return
                self._advanced(self, line)
            elif type(action) is Waiting:
                self.waiting = action.peers
            elif type(action) is Fault:
                self._fail(action.reason)
            elif type(action) is Finished:
                self._ended(self)
        deadline = core.next_deadline()
        if deadline is not None and deadline < self._timer:
            self._timer = deadline
            self._time.at(deadline, self._tick, deadline)

    def _tick(self, planned: float) -> None:
        if planned != self._timer:
            return
        self._timer = _NEVER
        deadline = self._core.next_deadline()
        if deadline is not None and deadline <= self._time.now:
            self._core.handle_timer(self._time.now)
        self._perform()

    def _fail(self, reason: str) -> None:
        if not self.fault:
            self.fault = reason
            self._ended(self)
