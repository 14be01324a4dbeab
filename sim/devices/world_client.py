"""The simulated body's link with its world: it reports its pose and LEDs, and takes the actions of people.

The pose goes to RUN/world.sock 25 times a second, changes of the LEDs as they happen. Actions (`sim.core.actions`)
arrive on RUN/<robot>/body.sock. A body that starts asks the world for its place, which the world may know from an
earlier process.
"""

import logging
from pathlib import Path

import msgpack

from sim.control import datagrams
from sim.core.action_effects import ActionEffects
from sim.core.actions import BODY_SOCKET, unpack
from sim.core.devices import SimulatedRobot
from swarm.errors import LocalError, RemoteError
from swarm.process.paths import socket_path

WORLD_SOCKET = "world.sock"
REPORT_S = 0.04
ANSWER_S = 0.5
"""Seconds that a world may take to say where the body had been."""
_ACTS_AT_ONCE = 4
_MAX_DATAGRAM = 4096

_log = logging.getLogger("body")


class WorldClient:
    """Reports to the world and takes actions. Only the constructor waits: for the world's answer about the place."""

    def __init__(self, name: str, robot: SimulatedRobot, runtime: Path, now: float) -> None:
        """`runtime` is the robot's runtime directory."""
        self._name, self._robot, self._body = name, robot, robot.body
        self._effects = ActionEffects(robot)
        self._world = str(socket_path(runtime.parent, WORLD_SOCKET))
        self._next = 0.0
        socket_path(runtime, BODY_SOCKET).unlink(missing_ok=True)  # of the process before
        self._socket = datagrams.receiver(runtime, BODY_SOCKET)
        self._ask(now)
        self._socket.setblocking(False)

    def look(self, now: float) -> None:
        """Report and take actions when it is time. This is called at every write to the bus."""
        changes = self._robot.atmega.led_changes
        while changes:
            t, (red, yellow, green) = changes[0]
            if not self._tell({"robot": self._name, "t": t, "red": red, "yellow": yellow, "green": green}):
                break  # a world on a busy machine has no room for a moment: it hears of it at the next look
            changes.popleft()
        if now < self._next:
            return
        self._next = now + REPORT_S
        for _ in range(_ACTS_AT_ONCE):  # before the report: the world need not tell it again what it has felt
            if not self._take(now):
                break
        body = self._body
        self._tell(
            {
                "robot": self._name,
                "t": now,
                "x": body.x,
                "y": body.y,
                "heading": body.heading,
                "tilt": body.tilt,
                "held": body.held,
                "speed": body.speed,
            }
        )
        self._effects.handle_timer(now)

    def _ask(self, now: float) -> None:
        self._socket.settimeout(ANSWER_S)
        if self._tell({"robot": self._name}) and not self._take(now):
            _log.warning("the world does not say where the body had been: it begins at its place")

    def _tell(self, message: dict[str, object]) -> bool:
        """Send a report to the world. Return False where there is no world (yet): the report is lost."""
        try:
            self._socket.sendto(msgpack.packb(message), self._world)
        except OSError:
            return False
        return True

    def _take(self, now: float) -> bool:
        """Do one action. Return False where none waits."""
        try:
            datagram = self._socket.recv(_MAX_DATAGRAM)
        except OSError:
            return False
        try:
            self._effects.do(unpack(datagram), now)
        except (LocalError, RemoteError) as error:
            _log.warning("an act that is none: %s", error)
        return True
