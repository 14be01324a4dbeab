"""The balancer's half that speaks to the bus: publishes what the loop tells, hands it the commands that pass.

`python -m services.balancer.bridge FD STOPS`, started by the loop with its ends of their two socket pairs. Ends with
the loop.

A stop is handed to the loop by Zenoh's thread at once. Commands are only put aside by that thread, since whatever it
does with a command, the stop behind it on the bus waits for; the main thread checks them and hands them on, so many a
tick as the loop takes, between the telemetry that it publishes.
"""

import contextlib
import math
import os
import select
import socket
import sys
import threading

from services.balancer.core.controller import CALIBRATING, COMMANDS, FAULT, STARTING
from services.balancer.core.inbox import Inbox, WaitingCommand
from services.balancer.core.requests import check
from services.balancer.core.screen import Composer
from services.balancer.link import MAX_DATAGRAM, Command, Message, pack, pack_command, unpack
from swarm import clock
from swarm.bus.throttle import THROTTLED, Throttle
from swarm.errors import LocalError, PayloadError
from swarm.messages import (
    AppState,
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
    Uwb,
    read,
)
from swarm.messages.keys import STOP, key, parse
from swarm.process.service import Service, run

SILENCE_S = 1.0
"""A loop that said nothing for so long is stuck."""
_POLL_S = 0.25
"""How soon a SIGTERM is seen."""
_TURN_S = 0.01
"""Least time between two times that commands are handed to the loop: its period."""
_COMMANDS_A_TURN = 8
"""As many as the loop takes in a tick (`services.balancer.child`)."""
_LOG_PERIOD_S = 5.0
"""Of refused commands: a flood of them is counted, not logged one by one."""

_NOTICES_A_SECOND = 10
"""About refused commands, at most."""

THROTTLED_STATE_S = 0.2
"""s between two messages of the throttled copy of the state; a change of mode is told at once."""

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
_COMMANDS = ("mode", "velocity", "parameters", "leds", "module", "imu", "notes", "display", "i2c")


class _Relay:
    """Both directions between the loop's socket and the bus."""

    def __init__(self, service: Service, loop: socket.socket, stops: socket.socket) -> None:
        self._service = service
        self._loop = loop
        self._stops = stops
        self._lock = threading.Lock()
        """Around the inbox, which Zenoh's thread fills."""
        self._inbox = Inbox(newest_only=key(service.robot, "balancer", "set", "velocity"))
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        """Written when the inbox is empty no longer; open until the process ends."""
        self._turn_at = 0.0
        """When commands may be handed to the loop again."""
        self._logged = -_LOG_PERIOD_S
        self._heard = clock.now()
        self._notices = 0
        self._notices_since = self._heard
        self._keys = {kind: key(service.robot, "balancer", topic) for kind, topic in _TOPICS.items()}
        self._throttle = Throttle(service.bus, self._keys[BalancerState], THROTTLED_STATE_S)
        self._mode = ""
        commands = (key(service.robot, "balancer", "set", what) for what in _COMMANDS)
        service.bus.subscribe(STOP, self._stop)
        service.bus.subscribe(commands, self._put)
        self._composer = Composer(service.robot)
        service.bus.subscribe([key(service.robot, "app", "*", "state", THROTTLED)], self._app_state)

    def run(self) -> None:
        """Until the loop is gone or the service shall stop."""
        poll = select.poll()
        poll.register(self._loop, select.POLLIN)
        poll.register(self._wake, select.POLLIN)
        while not self._service.stopping.is_set():
            wait_s = _POLL_S if not self._inbox else min(_POLL_S, max(0.0, self._turn_at - clock.now()))
            ready = [descriptor for descriptor, _ in poll.poll(math.ceil(wait_s * 1e3))]
            if self._loop.fileno() in ready and not self._take():
                self._service.log.info("the control loop ended")
                return
            if self._wake in ready:
                os.eventfd_read(self._wake)
            now = clock.now()
            if now - self._heard > SILENCE_S:
                self._service.degraded("the control loop is silent")
            if self._inbox and now >= self._turn_at:
                self._turn_at = now + _TURN_S
                self._hand_over_some()

    def _take(self) -> bool:
        """Publish a message of the loop; False where the loop has ended."""
        try:
            datagram = self._loop.recv(MAX_DATAGRAM, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return True
        except ConnectionError:
            return False
        if datagram:
            self._heard = clock.now()
            self._publish(unpack(datagram))
        return bool(datagram)

    def _publish(self, message: Message) -> None:
        if isinstance(message, BalancerState):
            self._composer.take_state(message)
            if (text := self._composer.lines(self._heard)) is not None:
                self._hand_over(text, "display", self._heard)
            if message.mode == FAULT:
                self._service.degraded(message.fault)
            elif message.mode not in (STARTING, CALIBRATING):
                self._service.ready()
            self._throttle.publish(message, message.t, news=message.mode != self._mode, urgent=True)
            self._mode = message.mode
        # The body's state goes ahead of whatever floods the bus.
        self._service.bus.publish(self._keys[type(message)], message, urgent=True)

    def _stop(self, name: str, payload: bytes) -> None:
        """A sample of `swarm/stop`, on Zenoh's thread: to the loop at once, whatever the payload is."""
        stop = read(name, payload)
        assert isinstance(stop, Stop)
        # Where the socket is full, there are stops in it that the loop has not taken yet; or the loop is gone.
        with contextlib.suppress(OSError):
            self._stops.send(pack(stop), socket.MSG_DONTWAIT)

    def _put(self, name: str, payload: bytes) -> None:
        """A command, on Zenoh's thread: aside with it."""
        with self._lock:
            first = not self._inbox
            self._inbox.put(WaitingCommand(name, payload, clock.now()))
        if first:
            os.eventfd_write(self._wake, 1)

    def _hand_over_some(self) -> None:
        """Check the commands that have waited longest and hand them to the loop, and tell which found no room."""
        if not select.select([], [self._loop], [], 0.0)[1]:
            return  # the loop is stuck: commands wait for it, as long as there is room
        with self._lock:
            commands, dropped = self._inbox.take(_COMMANDS_A_TURN), self._inbox.dropped()
        for name, count in dropped.items():
            self._refuse(name, "dropped", f"{name}: {count} commands, more than the control loop takes", count)
        for name, payload, heard in commands:
            self._command(name, payload, heard)

    def _command(self, name: str, payload: bytes, heard: float) -> None:
        """Check a command, and pass it on without waiting."""
        try:
            message = read(name, payload)
        except PayloadError as error:
            self._refuse(name, "refused", str(error))
            return
        if isinstance(message, SetMode) and message.mode not in COMMANDS:
            wrong = f"expected one of {', '.join(COMMANDS)}, got {message.mode[:40]!r}"
            self._refuse(name, "refused", f"{name}: mode: {wrong}")
            return
        try:
            check(message)
        except LocalError as error:
            self._refuse(name, "refused", f"{name}: {error}")
            return
        if isinstance(message, SetDisplay):
            until = math.inf if message.seconds is None else clock.now() + message.seconds
            self._composer.take_text(message.text, until)
        elif isinstance(message, Command):
            self._hand_over(message, name, heard)

    def _app_state(self, name: str, payload: bytes) -> None:
        """For the display; runs on Zenoh's thread. What is none is its sender's business."""
        with contextlib.suppress(PayloadError):
            if isinstance(message := read(name, payload), AppState):
                self._composer.take_app(parse(name).topic.partition("/")[0], message)

    def _hand_over(self, message: Command, name: str, heard: float) -> None:
        """To the loop, or away with it where that does not take it."""
        try:
            self._loop.send(pack_command(heard, message), socket.MSG_DONTWAIT)
        except BlockingIOError:
            self._refuse(name, "dropped", f"{name}: the control loop does not take commands")
        except OSError:
            return  # the loop is gone, and so are we in a moment

    def _refuse(self, name: str, counter: str, reason: str, count: int = 1) -> None:
        self._service.counters[counter] += count
        now = clock.now()
        if now - self._notices_since >= 1.0:
            self._notices, self._notices_since = 0, now
        self._notices += 1
        if self._notices <= _NOTICES_A_SECOND:
            notice = Notice(now, name.rpartition("/")[2], f"{counter}: {reason[:200]}")
            self._service.bus.publish(self._keys[Notice], notice)
        if now - self._logged >= _LOG_PERIOD_S:
            self._logged = now
            self._service.log.warning("command %s: %s", counter, reason[:200])


def main() -> None:
    """Bridge until the loop ends."""
    try:
        loop, stops = (socket.socket(fileno=int(text)) for text in sys.argv[1:])
    except (ValueError, OSError):
        raise LocalError("the bridge is started by `python -m services.balancer`, not by hand") from None
    with contextlib.closing(loop), contextlib.closing(stops), Service("balancer") as service:
        _Relay(service, loop, stops).run()


if __name__ == "__main__":
    run(main)
