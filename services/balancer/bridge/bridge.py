"""The balancer's half that speaks to the bus: publishes what the loop tells, hands it the commands that pass.

`python -m services.balancer.bridge.bridge FD STOPS [stopped]`, started by the loop with its ends of their two socket
pairs. It ends with the loop. `stopped`: a stop was the last that the loop has obeyed, so that this process begins with
what the one before it knew.

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

from services.balancer.bridge.bus_side import BusSide
from services.balancer.bridge.link import (
    COMMANDS_A_TICK,
    MAX_DATAGRAM,
    LoopCommand,
    LoopMessage,
    pack,
    pack_command,
    unpack,
)
from services.balancer.core.devices.screen import Composer
from services.balancer.core.faults import STOPPED
from services.balancer.core.inbox import Inbox, WaitingCommand
from swarm import clock
from swarm.bus import session_watch
from swarm.bus.session_watch import SessionWatch
from swarm.bus.throttle import THROTTLED
from swarm.errors import LocalError, PayloadError
from swarm.messages import AppState, BalancerState, SetDisplay, Stop, read
from swarm.messages.keys import key, parse
from swarm.process.service import Service, run

SILENCE_S = 1.0
"""A loop that said nothing for so long is stuck."""
UNANSWERED = 5
"""Questions to the router in a row without an answer after which the bridge ends, so that the loop starts another. The
loop balances on meanwhile."""
MAX_APPS = 16
"""Apps whose states wait for the display, at most."""
_POLL_S = 0.25
"""How soon a SIGTERM is seen."""
_TURN_S = 0.01
"""Least time between two times that commands are handed to the loop: its period."""


class _Relay:
    """Relays messages from the loop's socket to the bus and from the bus to the loop."""

    def __init__(self, service: Service, loop: socket.socket, stops: socket.socket, *, stopped: bool) -> None:
        self._service = service
        self._loop = loop
        self._stops = stops
        self._lock = threading.Lock()
        """Around the inbox, which Zenoh's thread fills."""
        self._inbox = Inbox(newest_only=key(service.robot, "balancer", "set", "velocity"))
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        """Written when the inbox is empty no longer; open until the process ends."""
        self._turn_at = 0.0
        """The time at which commands may be handed to the loop again."""
        self._heard = clock.now()
        self._ask_at = self._heard
        self._session = SessionWatch(service.bus, UNANSWERED)
        self._composer = Composer(service.robot)
        self._app_states: dict[str, bytes] = {}
        """The newest states of apps by key, which the display does not show yet."""
        self._side = BusSide(service, clock.now, self, stopped=stopped)
        self._side.listen(self._put)
        service.bus.subscribe([key(service.robot, "app", "*", "state", THROTTLED)], self._app_state)

    def run(self) -> None:
        """Relay until the loop is gone or the service shall stop."""
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
            if now >= self._ask_at:
                self._ask_at = now + session_watch.ASK_S
                self._session.look()
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

    def _publish(self, message: LoopMessage) -> None:
        if isinstance(message, BalancerState):
            self._show_apps()
            self._composer.take_state(message)
            text = self._composer.lines(self._heard)
            if text is not None and not self.take(text, self._heard):
                self._side.refuse("display", "dropped", "display: the control loop does not take commands")
        self._side.publish(message)

    def halt(self, stop: Stop) -> None:
        """See `services.balancer.bridge.bus_side.LoopLink`; on Zenoh's thread."""
        # Where the socket is full, there are stops in it that the loop has not taken yet; or the loop is gone.
        with contextlib.suppress(OSError):
            self._stops.send(pack(stop), socket.MSG_DONTWAIT)

    def take(self, command: LoopCommand, heard: float) -> bool:
        try:
            self._loop.send(pack_command(heard, command), socket.MSG_DONTWAIT)
        except (BlockingIOError, LocalError):  # it is full, or the command is too large
            return False
        except OSError:
            pass  # the loop is gone, and so is this process in a moment
        return True

    def show(self, request: SetDisplay) -> None:
        until = math.inf if request.seconds is None else clock.now() + request.seconds
        self._composer.take_text(request.text, until)

    def _put(self, name: str, payload: bytes) -> None:
        """Put a command into the inbox. Zenoh's thread calls this."""
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
            commands, dropped = self._inbox.take(COMMANDS_A_TICK), self._inbox.dropped()
        for name, count in dropped.items():
            self._side.refuse(name, "dropped", f"{name}: {count} commands, more than the control loop takes", count)
        for name, payload, heard in commands:
            self._side.command(name, payload, heard)

    def _app_state(self, name: str, payload: bytes) -> None:
        """Put an app's state aside for the display. Zenoh's thread calls this: it decodes nothing, as a stop waits."""
        if name in self._app_states or len(self._app_states) < MAX_APPS:
            self._app_states[name] = payload

    def _show_apps(self) -> None:
        """Show the apps' newest states. Damaged samples are ignored."""
        states, self._app_states = self._app_states, {}
        for name, payload in list(states.items()):
            with contextlib.suppress(PayloadError):
                if isinstance(message := read(name, payload), AppState):
                    self._composer.take_app(parse(name).topic.partition("/")[0], message)


def main() -> None:
    """Bridge until the loop ends."""
    try:
        loop, stops = (socket.socket(fileno=int(text)) for text in sys.argv[1:3])
    except (ValueError, OSError):
        raise LocalError("the bridge is started by `python -m services.balancer`, not by hand") from None
    with contextlib.closing(loop), contextlib.closing(stops), Service("balancer") as service:
        _Relay(service, loop, stops, stopped=sys.argv[3:] == [STOPPED]).run()


if __name__ == "__main__":
    run(main)
