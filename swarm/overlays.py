"""Messages to the whole swarm, or to one robot anywhere in it, for any process of a robot (docs/overlays.md).

    overlays = Overlays(bus, "r0", "myapp")
    reached = overlays.flood(b"hello").result(timeout=5.0)      # whom it reached, and whether that is all
    sent = overlays.send("r3", b"psst").result(timeout=5.0)     # whether it arrived

The mesh of this robot does the work and publishes the answers. A request is repeated until it is answered (the bus
may lose messages) and done once.
"""

import os
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from swarm import clock
from swarm.bus import Bus
from swarm.codec import decode
from swarm.errors import PayloadError
from swarm.keys import key, parse
from swarm.messages import Arm, Flooded, FloodRequest, SendRequest, Sent

REPEAT = 0.5
"""s after which a request without an answer is published again."""

MAX_OPEN = 4096
"""Requests that wait for an answer; the oldest ones are forgotten."""

A = TypeVar("A", Flooded, Sent)

OnPayload = Callable[[str, bytes], None]


class Handle(Generic[A]):
    """One request under way."""

    def __init__(self, ask: Callable[[], None]) -> None:
        self._ask = ask
        self._done = threading.Event()
        self._answer: A | None = None
        self._callback: Callable[[A], None] | None = None
        self._lock = threading.Lock()

    @property
    def done(self) -> bool:
        """Whether the answer is there."""
        return self._done.is_set()

    def result(self, timeout: float) -> A:
        """Wait for the answer; `TimeoutError` where none came within `timeout` s. It may come later."""
        end = clock.now() + timeout
        while not self._done.wait(min(REPEAT, max(0.0, end - clock.now()))):
            if clock.now() >= end:
                raise TimeoutError(f"no answer of the mesh within {timeout:g} s")
            self._ask()
        assert self._answer is not None
        return self._answer

    def on_done(self, callback: Callable[[A], None]) -> None:
        """Call `callback(answer)` when it is there, on Zenoh's thread; at once where it is."""
        with self._lock:
            self._callback = callback
            answer = self._answer
        if answer is not None:
            callback(answer)

    def finish(self, answer: A) -> None:
        """Called by `Overlays` when the answer came."""
        with self._lock:
            first = self._answer is None
            self._answer = answer
            callback = self._callback
        self._done.set()
        if first and callback is not None:
            callback(answer)


class Overlays:
    """What one process, under an app's name, floods and sends."""

    def __init__(self, bus: Bus, robot: str, app: str) -> None:
        """`app` is what both ends call themselves: payloads reach the processes of that name."""
        self._bus = bus
        self._robot = robot
        self._app = app
        self._prefix = os.urandom(6).hex()
        self._count = 0
        self._lock = threading.Lock()
        self._floods: dict[str, Handle[Flooded]] = {}
        self._messages: dict[str, Handle[Sent]] = {}
        self._flood_key = key(robot, "mesh", "set", "flood")
        self._send_key = key(robot, "mesh", "set", "send")
        bus.subscribe(key(robot, "mesh", "flooded"), self._on_flooded)
        bus.subscribe(key(robot, "mesh", "sent"), self._on_sent)

    def flood(self, payload: bytes, *, priority: str = "bulk", announce: bool = False) -> Handle[Flooded]:
        """To all robots. With `announce` all of them learn when it is complete."""
        request = FloodRequest(self._ticket(), self._app, payload, priority, announce)
        handle: Handle[Flooded] = Handle(lambda: self._bus.publish(self._flood_key, request, urgent=True))
        self._open(self._floods, request.ticket, handle)
        self._bus.publish(self._flood_key, request, urgent=True)
        return handle

    def send(self, to: str, payload: bytes, *, priority: str = "bulk", timeout: float = 30.0) -> Handle[Sent]:
        """To one robot. After `timeout` s the mesh gives it up, if not sooner."""
        request = SendRequest(self._ticket(), self._app, to, payload, priority, timeout)
        handle: Handle[Sent] = Handle(lambda: self._bus.publish(self._send_key, request, urgent=True))
        self._open(self._messages, request.ticket, handle)
        self._bus.publish(self._send_key, request, urgent=True)
        return handle

    def on_flood(self, callback: OnPayload) -> None:
        """Call `callback(origin, payload)` on Zenoh's thread for each flood of this app on other robots."""
        self._subscribe(key("*", "app", self._app, "flood"), callback)

    def on_message(self, callback: OnPayload) -> None:
        """Call `callback(sender, payload)` on Zenoh's thread for each message to this robot."""
        self._subscribe(key("*", "app", self._app, "send", self._robot), callback)

    def on_complete(self, callback: Callable[[str, Flooded], None]) -> None:
        """Call `callback(origin, answer)` on Zenoh's thread when another robot announces that a flood is complete."""

        def handle(name: str, payload: bytes) -> None:
            answer = _decoded(Flooded, name, payload)
            origin = parse(name).robot
            if answer is not None and answer.app == self._app and origin != self._robot:
                callback(origin, answer)

        self._bus.subscribe(key("*", "mesh", "flooded"), handle)

    def arm(self) -> None:
        """Take back every stop of the swarm that this robot knows of."""
        self._bus.publish(key(self._robot, "mesh", "set", "arm"), Arm(clock.now(), self._app), urgent=True)

    # -- inside ------------------------------------------------------------------------------------------------

    def _ticket(self) -> str:
        with self._lock:
            self._count += 1
            return f"{self._prefix}-{self._count}"

    def _open(self, handles: dict[str, Handle[A]], ticket: str, handle: Handle[A]) -> None:
        with self._lock:
            if len(handles) >= MAX_OPEN:
                del handles[next(iter(handles))]
            handles[ticket] = handle

    def _subscribe(self, keys: str, callback: OnPayload) -> None:
        def handle(name: str, payload: bytes) -> None:
            origin = parse(name).robot
            if origin != self._robot:
                callback(origin, payload)

        self._bus.subscribe(keys, handle)

    def _on_flooded(self, name: str, payload: bytes) -> None:
        self._finish(self._floods, _decoded(Flooded, name, payload))

    def _on_sent(self, name: str, payload: bytes) -> None:
        self._finish(self._messages, _decoded(Sent, name, payload))

    def _finish(self, handles: dict[str, Handle[A]], answer: A | None) -> None:
        if answer is not None:
            with self._lock:
                handle = handles.pop(answer.ticket, None)
            if handle is not None:
                handle.finish(answer)


def _decoded(kind: type[A], name: str, payload: bytes) -> A | None:
    """The answer; None where it is none, which only a broken process could have published."""
    try:
        return decode(kind, payload, name)
    except PayloadError:
        return None
