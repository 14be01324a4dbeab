"""`swarm drive ROBOT`: drive a robot by keyboard, with a dead-man's key.

A velocity is commanded only while keys come (`key_velocity`), and each command holds for less than a second. So the
robot stops by itself when the key is let go, when this program ends and when the connection breaks. Where the standard
input is no terminal its bytes are the keys, and its end is the end: that is how a laptop drives over ssh.
"""

import argparse
import contextlib
import sys
import threading
from pathlib import Path

from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError, PayloadError
from swarm.messages import BalancerFault, BalancerState, Notice, SetVelocity, Stop, read
from swarm.messages.keys import STOP, key
from swarm.onboard import halt
from swarm.onboard.body.key_velocity import STANDSTILL, KeyVelocity, Velocity
from swarm.onboard.body.keyboard import Keyboard
from swarm.onboard.buses import buses
from swarm.onboard.buses.ask import PATIENCE
from swarm.process.terminal import write_lines

STOP_WORD = "stop"
"""Said at the end where the person has stopped all robots. A laptop then gives the stop to all of them by ssh, too."""
REASON = "swarm drive"

KEYS = "arrows or w a s d: drive, q e: curves, + -: faster, slower, space: stop all robots, x: end"
ENDS = ("x", "escape")
_LOOK_S = 0.1
"""Seconds between two looks at the robot's state while no key comes."""
_SILENT_S = 1.0
"""Seconds without a state after which the connection counts as lost: 25 messages a second are due."""
_TOPICS = ("state", "fault", "notice")


class _Telltale:
    """The display of the balancer's state for the person who drives."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lines: list[str] = []
        self._fault: tuple[str, str] = ("", "")
        self._told: dict[str, float] = {}
        self.heard: float | None = None
        """The time at which the balancer's state came last."""

    def take(self, name: str, payload: bytes) -> None:
        """Take a message; called by the bus's thread."""
        with contextlib.suppress(PayloadError), self._lock:
            match read(name, payload):
                case BalancerState():
                    self.heard = clock.now()
                case BalancerFault(_, fault, reason, recovery) if (fault, reason) != self._fault:
                    self._fault = (fault, reason)
                    if fault:
                        self._lines.append(f"{reason}: {recovery}")
                case Notice(_, "velocity", text) if clock.now() > self._told.get(text, 0.0) + 1.0:
                    self._told[text] = clock.now()
                    way_out = ": swarm balance stand" if "balancing robot" in text else ""
                    self._lines.append(text.removeprefix("refused: ") + way_out)

    def lines(self) -> list[str]:
        """Return what is new, in order."""
        with self._lock:
            lines, self._lines = self._lines, []
            return lines


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "name", nargs="?", metavar="ROBOT", help="a robot of the simulation, or over ssh (default: this robot)"
    )
    buses.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Drive until x, Ctrl-C or the end of the input; code 1 where the robot was stopped or went silent."""
    robot, directory = one(args)
    keys, tale = Keyboard(sys.stdin), _Telltale()
    with Bus.of(directory) as bus:
        bus.subscribe([key(robot, "balancer", topic) for topic in _TOPICS], tale.take)
        if not bus.wait_connected(PATIENCE):
            raise LocalError(f"{robot}: no bus is there ({directory}); is the robot switched on?")
        with keys.raw():
            write_lines([f"{robot}: {KEYS}"])
            sys.stdout.flush()
            try:
                end = _drive(bus, robot, keys, tale)
            except KeyboardInterrupt:
                end = ""
            finally:
                _command(bus, robot, STANDSTILL)
    write_lines([*tale.lines(), f"{robot}: {end or 'end'}"])
    if end == STOP_WORD:
        sys.stdout.flush()
        write_lines(halt.table(halt.stop_over_buses(args.run_dir, REASON), stop=True))
    return 1 if end else 0


def one(args: argparse.Namespace) -> tuple[str, Path]:
    """Return the one robot that is meant and its runtime directory; raises `LocalError`."""
    if args.name and args.robots:
        raise LocalError("name the robot by --robots or as an argument, not by both")
    args.robots = [args.name] if args.name else args.robots
    found = buses.directories_of(args)
    if len(found) != 1:
        raise LocalError(f"which robot? there are {', '.join(found)}")
    ((robot, directory),) = found.items()
    return robot, directory


def _drive(bus: Bus, robot: str, keys: Keyboard, tale: _Telltale) -> str:
    """Drive until the person ends it; returns why it ended otherwise, or ""."""
    driver = KeyVelocity()
    began = clock.now()
    while True:
        now = clock.now()
        wait = _LOOK_S if driver.deadline is None else min(_LOOK_S, driver.deadline - now)
        for pressed in keys.read(wait):
            if pressed == " ":
                # At once on this bus; who has obeyed is asked afterwards.
                bus.publish(STOP, Stop(clock.now(), robot, REASON))
                return STOP_WORD
            if pressed in ENDS:
                return ""
            _command(bus, robot, driver.press(pressed, clock.now()))
        if keys.ended:
            return ""
        now = clock.now()
        _command(bus, robot, driver.handle_timer(now))
        if lines := tale.lines():
            write_lines(lines)
            sys.stdout.flush()
        heard = tale.heard if tale.heard is not None else began + PATIENCE - _SILENT_S
        if now > heard + _SILENT_S:
            return "its balancer has gone silent, so it stops by itself: swarm doctor tells why"


def _command(bus: Bus, robot: str, velocity: Velocity | None) -> None:
    if velocity is not None:
        message = SetVelocity(velocity.speed, velocity.turn_rate, velocity.seconds)
        bus.publish(key(robot, "balancer", "set", "velocity"), message, urgent=True)
