"""Messages to the whole swarm, or to one robot anywhere in it, for any process of a robot.

For authors of apps: docs/how-to/apps/talk-beyond-neighbours.md.

    overlays = Overlays(bus, "r0", "myapp")
    reached = overlays.flood(b"hello").result(timeout=5.0)      # whom it reached, and whether that is all
    sent = overlays.send("r3", b"psst").result(timeout=5.0)     # whether it arrived

The mesh of this robot does the work and publishes the answers. A request is repeated while somebody waits or looks for
its answer, and when the bus comes back (which may lose messages); it is done once.
"""

import math
import os
import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar

from swarm import clock
from swarm.bus.protocol import BusLike, Now
from swarm.errors import LocalError, shown
from swarm.messages import Arm, Flooded, FloodRequest, Progress, Reminder, SendRequest, Sent
from swarm.messages.codec import MAX_BINARY, decoded, encode
from swarm.messages.keys import key, parse

REPEAT = 0.5
"""Seconds after which a request without an answer is published again."""

MAX_OPEN = 1024
"""Requests that are remembered, answered or not; the oldest ones are forgotten."""

MAX_OPEN_BYTES = 4 * 1024 * 1024
"""Bytes of large requests that wait for their answer. A further one is refused."""

_REFUSED = f"refused: requests of more than {MAX_OPEN_BYTES // 2**20} MiB wait for the mesh"

ITSELF = "refused: a robot sends no message to itself"
"""The problem of such a message's answer."""

SMALL = 4096
"""Largest payload, in bytes, with which the whole request is repeated. Of a larger request only the ticket is
repeated."""

MAX_COLLECTED = 256
MAX_COLLECTED_BYTES = 4 * 1024 * 1024
"""Bytes of other robots' messages that wait until the app reads them. Beyond this the oldest ones are lost."""

A = TypeVar("A", Flooded, Sent)

OnPayload = Callable[[str, bytes], None]


class Message(NamedTuple):
    """A message that the same app on another robot has flooded, or sent to this robot."""

    sender: str
    payload: bytes
    flooded: bool


def check_payload(payload: object) -> None:
    """Raise `LocalError` for what no flood and no message carries."""
    if not isinstance(payload, bytes | bytearray | memoryview):
        raise LocalError(
            f"a payload is of bytes, got {shown(payload)}: text.encode() gives those of a text, msgpack.packb(value) "
            "those of numbers, lists and dicts"
        )
    if len(payload) > MAX_BINARY:
        raise LocalError(f"a payload of {len(payload)} bytes, the bus takes at most {MAX_BINARY} (960 KiB)")


class Handle(Generic[A]):
    """One request under way: wait for its `result`, look at its `answer`, or have a callback (`on_done`)."""

    def __init__(self, ticket: str, size: int, ask: Callable[[], None], remind: Callable[[], None], now: Now) -> None:
        """`ask()` makes the request of `size` bytes, `remind()` repeats it."""
        self._now = now
        self.size = size
        self.ticket = ticket
        """The name of the request, by which an app finds its answer later (`Overlays.answer`)."""
        self.moved = 0
        """Bytes of a large payload that have arrived, as of the last reminder."""
        self._ask = ask
        self._remind = remind
        self._asked_at = self._now()
        self._done = threading.Event()
        self._answer: A | None = None
        self._callback: Callable[[A], None] | None = None
        self._lock = threading.Lock()

    @property
    def done(self) -> bool:
        """Whether the answer is there."""
        return self._done.is_set()

    @property
    def answer(self) -> A | None:
        """The answer if it is there; never waits."""
        if self._answer is None and self._now() >= self._asked_at + REPEAT:
            self.ask_again()
        return self._answer

    def result(self, timeout: float) -> A:
        """Wait for the answer; `TimeoutError` where none came within `timeout` s. It may come later. Not to be called
        on Zenoh's thread, which brings the answer."""
        end = self._now() + timeout
        while not self._done.wait(min(REPEAT, max(0.0, end - self._now()))):
            if self._now() >= end:
                raise TimeoutError(f"no answer of the mesh within {timeout:g} s")
            self.ask_again()
        assert self._answer is not None
        return self._answer

    def ask_again(self) -> None:
        """Repeat the request: where it has arrived before, only the answer comes again."""
        self._asked_at = self._now()
        self._remind()

    def ask(self) -> None:
        """Make the request, payload and all."""
        self._asked_at = self._now()
        self._ask()

    def on_done(self, callback: Callable[[A], None]) -> None:
        """Call `callback(answer)` when it is there, on Zenoh's thread; at once where it is."""
        with self._lock:
            self._callback = callback
            answer = self._answer
        if answer is not None:
            callback(answer)

    def finish(self, answer: A) -> bool:
        """Called by `Overlays` when the answer came; True for the first time."""
        with self._lock:
            first = self._answer is None
            self._answer = answer
            callback = self._callback
            self._ask = self._remind = _nothing  # and let go of the payload
        self._done.set()
        if first and callback is not None:
            callback(answer)
        return first


class Overlays:
    """The requests of one process, under the name of its app, to flood and to send messages."""

    def __init__(self, bus: BusLike, robot: str, app: str, *, now: Now = clock.now, prefix: str | None = None) -> None:
        """`app` is what both ends call themselves: payloads reach the processes of that name. Tickets begin with
        `prefix`, which no other process may have: a random one, unless a simulation wants the same ones again."""
        self._now = now
        self._bus = bus
        self._robot = robot
        self._app = app
        self._prefix = prefix or os.urandom(6).hex()
        self._count = 0
        self._lock = threading.Lock()
        self._handles: dict[str, Handle[Any]] = {}
        self.asked: Callable[[FloodRequest | SendRequest], None] = lambda request: None
        """The function that gets each request, so that it can be recorded."""
        self._collected: deque[Message] = deque()
        self._collected_bytes = 0
        self._flood_key = key(robot, "mesh", "set", "flood")
        self._send_key = key(robot, "mesh", "set", "send")
        self._remind_key = key(robot, "mesh", "set", "remind")
        self._on_answer: Callable[[str, Flooded | Sent], None] | None = None
        # What is no answer, only a broken process could have published.
        bus.subscribe(key(robot, "mesh", "flooded"), decoded(Flooded, self._finish))
        bus.subscribe(key(robot, "mesh", "sent"), decoded(Sent, self._finish))
        bus.subscribe(key(robot, "mesh", "progress"), decoded(Progress, self._on_progress))
        bus.on_change(self._on_bus)

    def flood(self, payload: bytes, *, priority: str = "bulk", announce: bool = False) -> Handle[Flooded]:
        """Send `payload` to all robots. With `announce` all of them learn when all have it."""
        request = FloodRequest(self._ticket(), self._app, payload, priority, announce)
        refused = Flooded(self._now(), request.ticket, self._app, (), complete=False, problem=_REFUSED)
        return self._open(request, self._flood_key, refused)

    def send(self, to: str, payload: bytes, *, priority: str = "bulk", timeout: float = 30.0) -> Handle[Sent]:
        """Send `payload` to one other robot. The mesh gives it up after `timeout` s, if not sooner. Raises `LocalError`
        for a `timeout` in which no message arrives."""
        if not 0.0 < timeout < math.inf:
            raise LocalError(f"timeout: expected a time above 0 s, got {timeout!r}")
        request = SendRequest(self._ticket(), self._app, to, payload, priority, timeout)
        problem = ITSELF if to == self._robot else _REFUSED
        refused = Sent(self._now(), request.ticket, self._app, to, delivered=False, problem=problem)
        return self._open(request, self._send_key, refused, possible=to != self._robot)

    def answer(self, ticket: str) -> Flooded | Sent | None:
        """Return the answer to a request of this process, by its ticket; None as long as there is none, or of another
        one."""
        with self._lock:
            handle = self._handles.get(ticket)
        answer: Flooded | Sent | None = handle.answer if handle is not None else None
        return answer

    def collect(self) -> None:
        """Begin to keep what the same app on other robots floods and sends, for `messages`."""
        self.on_flood(lambda origin, payload: self._take(Message(origin, payload, flooded=True)))
        self.on_message(lambda sender, payload: self._take(Message(sender, payload, flooded=False)))

    def messages(self) -> list[Message]:
        """Return the messages since the last call, in the order of their arrival. Call `collect` before."""
        with self._lock:
            found = list(self._collected)
            self._collected.clear()
            self._collected_bytes = 0
        return found

    def on_answer(self, callback: Callable[[str, Flooded | Sent], None]) -> None:
        """Call `callback(ticket, answer)` on Zenoh's thread when a request of this process is answered; `remind` is to
        be called now and then."""
        self._on_answer = callback

    def remind(self) -> None:
        """Repeat the requests that have waited for `REPEAT` s."""
        with self._lock:
            waiting = [handle for handle in self._handles.values() if not handle.done]
        for handle in waiting:
            _ = handle.answer

    def on_flood(self, callback: OnPayload) -> None:
        """Call `callback(origin, payload)` on Zenoh's thread for each flood of this app on other robots."""
        self._subscribe(key("*", "app", self._app, "flood"), callback)

    def on_message(self, callback: OnPayload) -> None:
        """Call `callback(sender, payload)` on Zenoh's thread for each message to this robot."""
        self._subscribe(key("*", "app", self._app, "send", self._robot), callback)

    def on_complete(self, callback: Callable[[str, Flooded], None]) -> None:
        """Call `callback(origin, answer)` on Zenoh's thread when all have another robot's flood with `announce`."""

        def handle(name: str, payload: bytes) -> None:
            origin = parse(name).robot

            def take(answer: Flooded) -> None:
                if answer.app == self._app and origin != self._robot:
                    callback(origin, answer)

            decoded(Flooded, take)(name, payload)

        self._bus.subscribe(key("*", "mesh", "flooded"), handle)

    def arm(self) -> None:
        """Take back every stop of the swarm that this robot knows of."""
        self._bus.publish(key(self._robot, "mesh", "set", "arm"), Arm(self._now(), self._app), urgent=True)

    # -- inside ------------------------------------------------------------------------------------------------

    def _ticket(self) -> str:
        with self._lock:
            self._count += 1
            return f"{self._prefix}-{self._count}"

    def _open(self, request: FloodRequest | SendRequest, key: str, refused: A, *, possible: bool = True) -> Handle[A]:
        """Make a request; `refused` is its answer where it is not `possible`, or too many bytes wait already."""
        check_payload(request.payload)
        size = len(request.payload)
        small = size <= SMALL
        encode(request)  # names that are too long are refused here and now, too
        self.asked(request)
        # The bus has room for large ones in its ordinary queue alone.
        ask = partial(self._bus.publish, key, request, urgent=small)
        remind = ask if small else partial(self._bus.publish, self._remind_key, Reminder(request.ticket), urgent=True)
        handle: Handle[A] = Handle(request.ticket, size, ask, remind, self._now)
        with self._lock:
            waiting = 0 if small else sum(e.size for e in self._handles.values() if e.size > SMALL and not e.done)
            if len(self._handles) >= MAX_OPEN:
                del self._handles[next(iter(self._handles))]
            self._handles[handle.ticket] = handle
        if possible and (small or waiting + size <= MAX_OPEN_BYTES):
            handle.ask()
        else:
            self.remind()  # an answer that was lost must not take room for ever
            self._finish(refused)
        return handle

    def _take(self, message: Message) -> None:
        with self._lock:
            self._collected.append(message)
            self._collected_bytes += len(message.payload)
            while len(self._collected) > MAX_COLLECTED or self._collected_bytes > MAX_COLLECTED_BYTES:
                self._collected_bytes -= len(self._collected.popleft().payload)

    def _on_bus(self, connected: bool) -> None:
        """Repeat all requests that wait when the bus is back: what was asked while it was away is lost."""
        if connected:
            with self._lock:
                waiting = [handle for handle in self._handles.values() if not handle.done]
            for handle in waiting:
                handle.ask()

    def _subscribe(self, keys: str, callback: OnPayload) -> None:
        def handle(name: str, payload: bytes) -> None:
            origin = parse(name).robot
            if origin != self._robot:
                callback(origin, payload)

        self._bus.subscribe(keys, handle)

    def _on_progress(self, progress: Progress) -> None:
        with self._lock:
            handle = self._handles.get(progress.ticket)
        if handle is not None and progress.known:
            handle.moved = progress.moved
        elif handle is not None and not handle.done:
            handle.ask()

    def _finish(self, answer: Flooded | Sent) -> None:
        with self._lock:
            handle = self._handles.get(answer.ticket)
        if handle is not None and handle.finish(answer) and self._on_answer is not None:
            self._on_answer(answer.ticket, answer)


def _nothing() -> None:
    """Do nothing: the way to repeat a request that was answered."""
