"""The balancer's side of the bus: it publishes what its loop reports, and passes on the commands that are allowed.

The same code runs in the bridge, over the socket pairs to the control loop, and under virtual time, where the loop is a
body without physics (`sim.virtual.robot.balancer`).
"""

import contextlib
from collections.abc import Callable
from typing import Protocol

from services.balancer.bridge.link import LoopCommand, LoopMessage
from services.balancer.bridge.orders import moves
from services.balancer.core.control.controller import CALIBRATING, COMMANDS, FAULT, STARTING
from services.balancer.core.devices.requests import check
from swarm.bus.protocol import Now
from swarm.bus.throttle import THROTTLED, Throttle
from swarm.errors import LocalError, PayloadError
from swarm.messages import (
    Arm,
    BalancerFault,
    BalancerState,
    Battery,
    Buttons,
    Display,
    Firmware,
    I2CRates,
    ImuSample,
    Leds,
    ModuleAnswer,
    Notice,
    Odometry,
    Parameters,
    SetDisplay,
    SetMode,
    Stop,
    Stopped,
    Uwb,
    read,
)
from swarm.messages.keys import STOP, key
from swarm.messages.service import short_reason, stop_of
from swarm.process.runtime import Process

THROTTLED_STATE_S = 0.2
"""Seconds between two messages of the state's throttled copy; a change of mode is told at once."""

_LOG_PERIOD_S = 5.0
"""Seconds between two log lines about refused commands: a flood of them is counted, not logged one by one."""

_NOTICES_A_SECOND = 10
"""Notices about refused commands, at most."""

_TOPICS: dict[type, str] = {
    BalancerState: "state",
    Odometry: "odometry",
    Leds: "leds",
    BalancerFault: "fault",
    Notice: "notice",
    Parameters: "parameters",
    Battery: "battery",
    Firmware: "firmware",
    Buttons: "buttons",
    ImuSample: "imu",
    Uwb: "uwb",
    ModuleAnswer: "module",
    Display: "display",
    I2CRates: "i2c",
}
_COMMANDS = ("mode", "velocity", "parameters", "leds", "module", "imu", "notes", "display", "i2c", "motors")


class LoopLink(Protocol):
    """The balancer's loop as the bus side sees it."""

    def halt(self, stop: Stop) -> None:
        """Stop the motors. Called by the bus's thread, and must not wait."""

    def take(self, command: LoopCommand, heard: float) -> bool:
        """Take a command that was heard at that time, s; False where there is no room for it."""

    def show(self, request: SetDisplay) -> None:
        """Show a text on the display."""


class BusSide:
    """The bus side of one balancer."""

    def __init__(self, process: Process, now: Now, loop: LoopLink, *, stopped: bool = False) -> None:
        """`stopped`: whether a stop was the last that the loop has obeyed."""
        self._process = process
        self._now = now
        self._loop = loop
        self._logged = float("-inf")
        self._notices = 0
        self._notices_since = now()
        self._keys: dict[type, str] = {}
        """The keys used so far, by the message's type: the simulations have many robots, which use few of them."""
        self._throttle = Throttle(process.bus, self.key(BalancerState), THROTTLED_STATE_S)
        self._mode = ""
        self._unknown: Stop | None = None
        """The newest stop that was given on this bus, until the mesh tells that it knows of it, or somebody takes it
        back."""
        self._unknown_since = 0.0
        self._stopped_at: float | None = now() if stopped else None
        """The time at which a stop was heard last, or at which the mesh told last that one holds, s. None once the mesh
        has told that none holds."""

    def listen(self, put: Callable[[str, bytes], None]) -> None:
        """Hear stops, which go to the loop at once, and commands: `put(key, payload)` is to see to it that `command` is
        called for each. Both are called by the bus's thread: whatever `put` does, the next stop waits for it."""
        robot, bus = self._process.robot, self._process.bus
        bus.subscribe(STOP, lambda _, payload: self._stop(payload))
        bus.subscribe(key(robot, "mesh", "stopped"), self._take_stopped)
        bus.subscribe(key(robot, "mesh", "set", "arm"), self._forget_stop)
        bus.on_change(self._ask_mesh)
        bus.subscribe([key(robot, "balancer", "set", what) for what in _COMMANDS], put)

    def key(self, kind: type) -> str:
        """Return the key of the messages of a type."""
        found = self._keys.get(kind)
        if found is None:
            found = self._keys[kind] = key(self._process.robot, "balancer", _TOPICS[kind])
        return found

    @property
    def state_keys(self) -> tuple[str, str]:
        """The keys on which the state is published."""
        state = self.key(BalancerState)
        return state, f"{state}/{THROTTLED}"

    def publish(self, message: LoopMessage) -> None:
        """Publish a message of the loop."""
        process = self._process
        if isinstance(message, BalancerState):
            if message.mode == FAULT:
                process.degraded(message.fault)
            elif message.mode not in (STARTING, CALIBRATING):
                process.ready()
            self._throttle.publish(message, message.t, news=message.mode != self._mode, urgent=True)
            self._mode = message.mode
        # The body's state goes ahead of whatever floods the bus.
        process.bus.publish(self.key(type(message)), message, urgent=True)

    def command(self, name: str, payload: bytes, heard: float) -> None:
        """Check a command that was heard at that time, s, and hand it to the loop; tell where it is refused."""
        try:
            message = read(name, payload)
        except PayloadError as error:
            self.refuse(name, "refused", str(error))
            return
        if isinstance(message, SetMode) and message.mode not in COMMANDS:
            wrong = f"expected one of {', '.join(COMMANDS)}, got {message.mode[:40]!r}"
            self.refuse(name, "refused", f"{name}: mode: {wrong}")
            return
        try:
            check(message)
        except LocalError as error:
            self.refuse(name, "refused", f"{name}: {error}")
            return
        if self._stopped_at is not None and isinstance(message, LoopCommand) and moves(message):
            self.refuse(name, "refused", f"{name}: the swarm is stopped: swarm arm takes that back")
        elif isinstance(message, SetDisplay):
            self._loop.show(message)
        elif isinstance(message, LoopCommand) and not self._loop.take(message, heard):
            self.refuse(name, "dropped", f"{name}: the control loop does not take commands")

    def refuse(self, name: str, counter: str, reason: str, count: int = 1) -> None:
        """Count `count` commands of a key that do not reach the loop, and tell why."""
        process = self._process
        process.counters[counter] += count
        now = self._now()
        if now - self._notices_since >= 1.0:
            self._notices, self._notices_since = 0, now
        self._notices += 1
        if self._notices <= _NOTICES_A_SECOND:
            notice = Notice(now, name.rpartition("/")[2], f"{counter}: {reason[:200]}")
            process.bus.publish(self.key(Notice), notice)
        if now - self._logged >= _LOG_PERIOD_S:
            self._logged = now
            process.log.warning("command %s: %s", counter, reason[:200])

    def _stop(self, payload: bytes) -> None:
        """Pass a sample of `swarm/stop` to the loop at once, whatever it holds, also one that was published under a
        wildcard."""
        stop = stop_of(payload)
        if not stop.repeated:
            self._unknown, self._unknown_since = stop, self._now()
        self._stopped_at = self._now()
        self._loop.halt(stop)

    def _forget_stop(self, name: str, payload: bytes) -> None:
        """Somebody takes back the stops that were known then. The mesh may not be there to hear it."""
        with contextlib.suppress(PayloadError):
            arm = read(name, payload)
            assert isinstance(arm, Arm)
            if self._unknown_since <= self._now() - max(0.0, arm.age):
                self._unknown = None

    def _ask_mesh(self, connected: bool) -> None:
        """Ask the mesh whether a stop holds, which may be one that nobody on this bus has heard."""
        if connected:
            self._process.bus.ask(key(self._process.robot, "mesh", "stopped"), self._take_stopped)

    def _take_stopped(self, name: str, payload: bytes) -> None:
        """Refuse commands that move the robot from the time on at which the mesh tells that a stop holds, and let them
        pass again where it tells that none holds. A sample that cannot be read changes nothing."""
        try:
            message = read(name, payload)
        except PayloadError as error:
            self.refuse(name, "refused", str(error))
            return
        assert isinstance(message, Stopped)
        # The mesh notes a stop of this bus under this robot's name.
        if self._unknown is not None and message.by.get(self._process.robot) == short_reason(self._unknown.reason):
            self._unknown = None
        # What the mesh told before the stop says nothing about it.
        if self._stopped_at is not None and message.t <= self._stopped_at:
            return
        if (unknown := self._unknown) is not None:
            # The mesh was not there when the stop was given, so nobody else has heard of it. The mesh gets it before
            # somebody takes back the stops that the mesh knows.
            self._unknown, self._stopped_at = None, self._now()
            self._process.bus.publish(STOP, unknown, urgent=True)
            return
        self._stopped_at = message.t if message.stopped else None
