"""What a robot's bus says, for a page far away: `python -m swarm.fleet.lookout ROBOT` at the other end of ssh.

Out go msgpack arrays, of each key the newest value at most `RATE` times a second, so that a slow network makes steps
and no queue:

    ["bus", there]               whether there is a bus, at first and when that changes
    ["key", key, payload]        a message
    ["alive", key, there]        a service's token
    ["passed", robot, count]     messages of that robot's synchronous or asynchronous apps that its mesh brought here

In come arrays `[key, payload]`, to be published. It ends when its input does, so nothing stays behind on a robot.
"""

import contextlib
import os
import select
import sys
import threading
from collections.abc import Callable

import msgpack

from swarm.bus import Bus
from swarm.errors import LocalError, PayloadError
from swarm.keys import EVERYTHING, STOP, key, parse
from swarm.paths import runtime_dir

RATE = 10.0
MAX_KEYS = 4096
"""That wait to be told; an app that publishes under ever new ones must not fill the memory."""
MAX_COMMAND = 4096
"""bytes: one write to a pipe that is whole or nothing."""

TOLD_ONCE = (
    "*/status", "app/*/status", "app/*/parameters", "app/*/epoch", "mesh/members", "mesh/stopped", "mesh/topology",
)  # fmt: skip
"""Keys below a robot's name that are told on change and answer questions: who comes late asks."""

_ANSWER_S = 2.0
_BETWEEN_APPS = ("flood", "send")
_COUNTED = ("sync", "latest")


class Lookout:
    """What is new since it was told last."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._lock = threading.Lock()
        self._keys: dict[str, bytes] = {}
        self._alive: dict[str, bool] = {}
        self._passed: dict[str, int] = {}
        self._changed: set[str] = set()
        self._bus: bool | None = None

    def take(self, name: str, payload: bytes) -> None:
        """A sample of the bus."""
        try:
            robot, service, topic = parse(name)
        except PayloadError:
            return
        kind = topic.split("/")[1:2]
        with self._lock:
            if service == "app" and kind and kind[0] in _COUNTED:
                if robot != self._robot and (robot in self._passed or len(self._passed) < MAX_KEYS):
                    self._passed[robot] = self._passed.get(robot, 0) + 1
                    self._changed.add(robot)
            elif service == "app" and kind and kind[0] in _BETWEEN_APPS:
                return
            elif name in self._keys or len(self._keys) < MAX_KEYS:
                self._keys[name] = payload

    def alive(self, name: str, there: bool) -> None:
        """A service's process has come or gone."""
        with self._lock:
            self._alive[name] = there

    def bus(self, there: bool) -> None:
        """The bus has come or gone."""
        with self._lock:
            self._bus = there

    def news(self) -> bytes:
        """What is new, packed; empty where nothing is."""
        with self._lock:
            said: list[list[object]] = [] if self._bus is None else [["bus", self._bus]]
            said += (["alive", name, there] for name, there in self._alive.items())
            said += (["key", name, payload] for name, payload in self._keys.items())
            said += (["passed", robot, self._passed[robot]] for robot in self._changed)
            self._bus = None
            self._alive.clear()
            self._keys.clear()
            self._changed.clear()
        return b"".join(msgpack.packb(each) for each in said)


def watch(bus: Bus, robot: str, take: Callable[[str, bytes], None], alive: Callable[[str, bool], None]) -> None:
    """Hear all of a robot's bus from now on, and what was said before and still holds."""

    def ask(connected: bool) -> None:
        for topic in TOLD_ONCE if connected else ():
            bus.ask(key(robot, *topic.split("/")), take, timeout_s=_ANSWER_S)

    bus.subscribe(EVERYTHING, take)
    bus.watch(key("*", "**", "alive"), alive)
    bus.on_change(ask)


def publish(bus: Bus, command: object) -> None:
    """What the page wants said on the bus; anything that is no command is left out."""
    match command:
        case [str(name), bytes(payload)] if name == STOP or name.startswith("swarm/"):
            with contextlib.suppress(LocalError):
                bus.publish(name, payload, urgent=True)


def main() -> None:
    """For the robot that this is."""
    robot = sys.argv[1]
    lookout = Lookout(robot)
    commands = msgpack.Unpacker(max_buffer_size=16 * MAX_COMMAND)
    with Bus.of(runtime_dir()) as bus:
        lookout.bus(bus.wait_connected(1.0))
        bus.on_change(lookout.bus)
        watch(bus, robot, lookout.take, lookout.alive)
        with contextlib.suppress(BrokenPipeError):
            while True:
                if select.select([sys.stdin], [], [], 1.0 / RATE)[0]:
                    data = os.read(sys.stdin.fileno(), MAX_COMMAND)
                    if not data:
                        return
                    commands.feed(data)
                    for command in commands:
                        publish(bus, command)
                elif news := lookout.news():
                    _write(news)


def _write(data: bytes) -> None:
    while data:
        data = data[os.write(sys.stdout.fileno(), data) :]


if __name__ == "__main__":
    main()
