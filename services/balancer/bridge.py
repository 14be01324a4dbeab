"""The balancer's half that speaks to the bus: publishes what the loop tells, hands it the commands that pass.

`python -m services.balancer.bridge FD`, started by the loop with its end of their socket pair. Ends with the loop.
"""

import contextlib
import socket
import sys

from services.balancer.core.controller import COMMANDS, FAULT
from services.balancer.core.requests import check
from services.balancer.link import MAX_DATAGRAM, Command, Message, pack, unpack
from swarm import clock
from swarm.errors import LocalError, PayloadError
from swarm.keys import STOP, key
from swarm.messages import (
    BalancerState,
    Battery,
    Buttons,
    ImuSample,
    Leds,
    ModuleAnswer,
    Odometry,
    SetMode,
    Uwb,
    read,
)
from swarm.service import Service, run

SILENCE_S = 1.0
"""A loop that said nothing for so long is stuck."""
_POLL_S = 0.25
"""How soon a SIGTERM is seen."""
_LOG_PERIOD_S = 5.0
"""Of refused commands: a flood of them is counted, not logged one by one."""

_TOPICS = {
    BalancerState: "state",
    Odometry: "odometry",
    Leds: "leds",
    Battery: "battery",
    Buttons: "buttons",
    ImuSample: "imu",
    Uwb: "uwb",
    ModuleAnswer: "module",
}
_COMMANDS = ("mode", "leds", "module", "imu")


class Relay:
    """Both directions between the loop's socket and the bus."""

    def __init__(self, service: Service, loop: socket.socket) -> None:
        self._service = service
        self._loop = loop
        self._loop.settimeout(_POLL_S)
        self._logged = -_LOG_PERIOD_S
        self._heard = clock.now()
        self._keys: dict[type, str] = {kind: key(service.robot, "balancer", topic) for kind, topic in _TOPICS.items()}
        commands = (key(service.robot, "balancer", "set", what) for what in _COMMANDS)
        service.bus.subscribe([STOP, *commands], self._command)

    def run(self) -> None:
        """Until the loop is gone or the service shall stop."""
        while not self._service.stopping.is_set():
            try:
                datagram = self._loop.recv(MAX_DATAGRAM)
            except TimeoutError:
                if clock.now() - self._heard > SILENCE_S:
                    self._service.degraded("the control loop is silent")
                continue
            except ConnectionError:
                datagram = b""
            if not datagram:
                self._service.log.info("the control loop ended")
                return
            self._heard = clock.now()
            self._publish(unpack(datagram))

    def _publish(self, message: Message) -> None:
        if isinstance(message, BalancerState):
            if message.mode == FAULT:
                self._service.degraded(message.fault)
            elif message.mode != "starting":
                self._service.ready()
        # The body's state goes ahead of whatever floods the bus.
        self._service.bus.publish(self._keys[type(message)], message, urgent=True)

    def _command(self, name: str, payload: bytes) -> None:
        """Runs on Zenoh's thread: check, and pass on without waiting."""
        try:
            message = read(name, payload)
        except PayloadError as error:
            self._refuse("refused", str(error))
            return
        if isinstance(message, SetMode) and message.mode not in COMMANDS:
            self._refuse("refused", f"{name}: mode: expected one of {', '.join(COMMANDS)}, got {message.mode!r}")
        elif isinstance(message, Command):
            try:
                check(message)
            except LocalError as error:
                self._refuse("refused", f"{name}: {error}")
                return
            try:
                self._loop.send(pack(message), socket.MSG_DONTWAIT)
            except BlockingIOError:
                self._refuse("dropped", f"{name}: the control loop does not take commands")
            except OSError:
                return  # the loop is gone, and so are we in a moment

    def _refuse(self, counter: str, reason: str) -> None:
        self._service.counters[counter] += 1
        now = clock.now()
        if now - self._logged >= _LOG_PERIOD_S:
            self._logged = now
            self._service.log.warning("command %s: %s", counter, reason[:200])


def main() -> None:
    """Bridge until the loop ends."""
    try:
        descriptor = int(sys.argv[1])
        loop = socket.socket(fileno=descriptor)
    except (IndexError, ValueError, OSError):
        raise LocalError("the bridge is started by `python -m services.balancer`, not by hand") from None
    with contextlib.closing(loop), Service("balancer") as service:
        Relay(service, loop).run()


if __name__ == "__main__":
    run(main)
