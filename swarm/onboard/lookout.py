"""The reports on a robot's bus for a page far away: `python -m swarm.onboard.lookout ROBOT` at the other end of ssh.

Out go msgpack arrays, of each key the newest value at most `RATE` times a second, so that a slow network makes steps
and no queue:

    ["bus", there]               whether there is a bus, at first and when that changes
    ["key", key, payload]        a message
    ["alive", key, there]        a service's token
    ["clock", t]                 this robot's clock as this was written
    ["passed", robot, count]     messages of that robot's synchronous or asynchronous apps that the mesh brought here,
                                 as long as they are few (`swarm.onboard.traffic`)

In come arrays `[key, payload]`, to be published. The end of a stop has a third entry: the time by this robot's clock at
which the laptop wrote it. The time for which a network held it up counts for its age: so it takes back no stop that was
given meanwhile. The program ends when its input does, so nothing stays behind on a robot.

Commands never wait for telemetry: the main thread only reads and publishes commands; a second thread writes the
telemetry and may wait for a slow reader as long as it takes. What is new meanwhile replaces what was not yet written.
"""

import contextlib
import math
import os
import select
import sys
import threading
from collections.abc import Callable, Iterable, Iterator

import msgpack

from swarm import clock
from swarm.bus.zenoh_bus import Bus
from swarm.errors import LocalError, PayloadError
from swarm.messages import Arm
from swarm.messages.codec import MAX_PAYLOAD, decode
from swarm.messages.keys import STOP, key, owner_of, parse
from swarm.onboard.traffic import Traffic
from swarm.process.paths import runtime_dir

RATE = 10.0
MAX_KEYS = 4096
"""Keys, tokens and senders each that may wait to be written; an app that publishes under ever new keys must not fill
the memory."""
MAX_WAITING = 2 << 20
"""Bytes of messages that may wait to be written, for the same reason."""
MAX_COMMAND = 4096
"""Largest command, bytes: one write to a pipe that is whole or nothing."""

_MAX_ENTRIES = 16
"""Entries of an array that comes in; each of ours has three at most, one of a later release may have more."""

TOLD_ONCE = (
    "*/status", "app/*/status", "app/*/parameters", "app/*/epoch", "mesh/members", "mesh/stopped", "mesh/topology",
)  # fmt: skip
"""Keys below a robot's name that are told on change and answer questions: who comes late asks."""

TOLD = (
    "*/*", "*/set/*", "app/*/*", "app/*/set/*", "app/*/*/state", "app/*/*/progress", "app/*/*/epoch",
    "app/*/out/**", "app/*/record/*",
)  # fmt: skip
"""Keys below a robot's name that are for people too: all but what apps send to each other, which would cost the bus
more than the rest together (`swarm.onboard.traffic`)."""

_BUS_S = 5.0
"""Seconds for which commands wait for the bus at the start: the program may be called for a single command, which would
be lost without a bus."""
_ANSWER_S = 2.0
_END_S = 1.0
"""Seconds for which the end waits for the thread that writes."""


class Lookout:
    """The samples since the last report, the newest one of each key."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._keys: dict[str, bytes] = {}
        self._waiting = 0
        """Bytes of the messages in `_keys`."""
        self._alive: dict[str, bool] = {}
        self._passed: dict[str, int] = {}
        self._bus: bool | None = None

    def take(self, name: str, payload: bytes) -> None:
        """Keep a sample of the bus. Samples above a message's size, and those beyond the memory limit, are left out."""
        try:
            _, service, topic = parse(name)
        except PayloadError:
            return
        if service == "app" and topic.endswith("/flood"):
            return
        with self._lock:
            waiting = self._waiting + len(payload) - len(self._keys.get(name, b""))
            has_room = waiting <= MAX_WAITING and (name in self._keys or len(self._keys) < MAX_KEYS)
            if has_room and len(payload) <= MAX_PAYLOAD:
                self._keys[name] = payload
                self._waiting = waiting

    def passed(self, sender: str, count: int) -> None:
        """Set the number of messages received from a robot's apps."""
        with self._lock:
            if sender in self._passed or len(self._passed) < MAX_KEYS:
                self._passed[sender] = count

    def alive(self, name: str, there: bool) -> None:
        """Note that a service's process has come or gone."""
        with self._lock:
            if name in self._alive or len(self._alive) < MAX_KEYS:
                self._alive[name] = there

    def bus(self, there: bool) -> None:
        """Note that the bus has come or gone."""
        with self._lock:
            self._bus = there

    def news(self) -> bytes:
        """Return what is new as packed bytes; empty where nothing is."""
        with self._lock:
            said: list[list[object]] = [] if self._bus is None else [["bus", self._bus]]
            said += (["alive", name, there] for name, there in self._alive.items())
            said += (["key", name, payload] for name, payload in self._keys.items())
            said += (["passed", robot, count] for robot, count in self._passed.items())
            self._bus = None
            self._alive.clear()
            self._keys.clear()
            self._waiting = 0
            self._passed.clear()
        return b"".join(msgpack.packb(each) for each in said)


def watch(bus: Bus, robot: str, take: Callable[[str, bytes], None], alive: Callable[[str, bool], None]) -> None:
    """Take the messages on a robot's bus from now on, and earlier ones that still hold."""

    def ask(connected: bool) -> None:
        for topic in TOLD_ONCE if connected else ():
            bus.ask(key(robot, *topic.split("/")), take, timeout_s=_ANSWER_S)

    bus.subscribe([key("*", *topic.split("/")) for topic in TOLD], take)
    bus.watch(key("*", "**", "alive"), alive)
    bus.on_change(ask)


def unpacked(parts: Iterable[bytes], longest: int) -> Iterator[object]:
    """Yield the values in a stream of msgpack that comes in parts, in the memory that a value of `longest` bytes needs.

    Raises `PayloadError` where it is no msgpack, an array has too many entries, or a value is longer.
    """
    # A list is made as long as its header claims, and so are those that begin within it. The unpacker's bound for its
    # buffer does not count the bytes that have become entries of a list which is not yet whole.
    unpacker = msgpack.Unpacker(max_array_len=_MAX_ENTRIES)
    begun = 0
    for part in parts:
        begun += len(part)
        try:
            unpacker.feed(part)
            for value in unpacker:
                begun = 0
                yield value
        except (ValueError, TypeError, OverflowError, msgpack.UnpackException) as error:
            raise PayloadError(f"it is no msgpack: {type(error).__name__}") from None
        if begun > longest:
            raise PayloadError(f"a value is longer than {longest} bytes")


def publish(bus: Bus, command: object) -> None:
    """Publish a command of the page on the bus; anything that is no command is left out."""
    match command:
        case [str(name), bytes(payload)] if name == STOP or owner_of(name) is not None:
            with contextlib.suppress(LocalError):
                bus.publish(name, payload, urgent=True)
        case [str(name), bytes(payload), float(written)] if math.isfinite(written) and owner_of(name) is not None:
            with contextlib.suppress(LocalError, PayloadError):
                arm = decode(Arm, payload, name)
                late = max(0.0, clock.now() - written)
                bus.publish(name, Arm(arm.t, arm.origin, arm.age + late), urgent=True)


def main() -> None:
    """Report the bus of the robot on which this runs."""
    robot = sys.argv[1]
    lookout = Lookout()
    ended, closing = os.eventfd(0), threading.Event()
    with Bus.of(runtime_dir()) as bus:
        lookout.bus(bus.wait_connected(1.0))
        bus.on_change(lookout.bus)
        watch(bus, robot, lookout.take, lookout.alive)
        traffic = Traffic(bus, robot, lookout.passed)

        def tell() -> None:
            try:
                with contextlib.suppress(BrokenPipeError):
                    while not closing.wait(1.0 / RATE):
                        traffic.look(clock.now())
                        _write(lookout.news() + msgpack.packb(["clock", clock.now()]))
            finally:  # nobody hears us, or this is a defect: nothing stays behind that answers nobody
                os.eventfd_write(ended, 1)

        telling = threading.Thread(target=tell, name="telemetry", daemon=True)
        telling.start()
        try:
            bus.wait_connected(_BUS_S)
            for command in unpacked(_input(ended), MAX_COMMAND):
                publish(bus, command)
        except PayloadError as error:
            sys.exit(f"lookout: the input is no sequence of commands: {error}")
        finally:
            # A thread that comes back from Zenoh while the interpreter ends would abort the process. One that waits for
            # a slow reader may stay where it is.
            closing.set()
            telling.join(_END_S)


def _input(ended: int) -> Iterator[bytes]:
    """Yield the input as it arrives, until it ends or `ended` (an eventfd) is set."""
    source = sys.stdin.fileno()
    while source in select.select([source, ended], [], [])[0]:
        data = os.read(source, MAX_COMMAND)
        if not data:
            return
        yield data


def _write(data: bytes) -> None:
    """Write all data, however long the reader takes."""
    while data:
        data = data[os.write(sys.stdout.fileno(), data) :]


if __name__ == "__main__":
    main()
