"""The threads around a node: one reader for each connection, one pump for timers, callers and full sockets.

Whoever makes the node produce bytes sends them at once, be it a reader, the pump or Zenoh's callback: no
hand-over between threads delays a message. The node runs under one lock, in which nothing waits. What is to
be published on the bus is published after the lock is released, by the reader that got it, so each link's
messages keep their order.
"""

import contextlib
import logging
import os
import select
import threading
from collections.abc import Callable, Sequence
from typing import Protocol

from services.mesh.core.events import Received
from services.mesh.core.frames import BULK
from services.mesh.core.node import Action, Close, Dial, LinksChanged, Node, Note
from services.mesh.core.session import Session
from services.mesh.links.pipe import Pipe, describe
from swarm import clock
from swarm.messages import LinkState

_CHUNK = 4096
"""Bytes taken from a session at a time; what is taken can no longer be overtaken."""

_JOIN_TIMEOUT = 2.0
"""s to wait for each thread at the end; one may hang in a dial."""

_log = logging.getLogger("mesh")


class Listener(Protocol):
    """Where neighbours reach this robot."""

    def fileno(self) -> int:
        """For select."""

    def accept(self) -> Pipe:
        """The next caller; raises OSError where it has gone already."""

    def close(self) -> None:
        """Stop listening."""


class Runner:
    """Runs one node until `stop`."""

    def __init__(
        self,
        node: Node,
        *,
        listeners: Sequence[Listener],
        dial: Callable[[str], Pipe],
        deliver: Callable[[str, bytes, bool], None],
        changed: Callable[[], None],
    ) -> None:
        """`dial(peer)` connects or raises OSError. Called without the lock: `deliver(key, payload, urgent)`
        for what came in, `changed()` when a link did."""
        self._node = node
        self._listeners = listeners
        self._dial = dial
        self._deliver = deliver
        self._changed = changed
        self._lock = threading.Lock()
        self._pipes: dict[Session, Pipe] = {}
        self._blocked: dict[Session, Pipe] = {}
        self._threads: set[threading.Thread] = set()
        self._stopping = False
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._pump_until = 0.0
        self._pump = threading.Thread(target=self._run, name="mesh-pump")

    def start(self) -> None:
        """Begin to dial and to listen."""
        self._pump.start()

    def publish(self, source: int, key: str, payload: bytes) -> None:
        """A sample of the own bus; may be called on Zenoh's thread, never waits for a socket."""
        with self._lock:
            self._node.publish(source, key, payload, clock.now())
            actions = self._carry_out()
        self._report(actions)

    def links(self) -> tuple[LinkState, ...]:
        """All links as they are."""
        with self._lock:
            return self._node.links()

    def stop(self) -> None:
        """Say goodbye to the neighbours and end all threads."""
        with self._lock:
            self._stopping = True
            self._node.close(clock.now())
            actions = self._carry_out()
        self._report(actions)
        os.eventfd_write(self._wake, 1)
        self._pump.join()
        for thread in tuple(self._threads):
            thread.join(_JOIN_TIMEOUT)
        os.close(self._wake)

    # -- one step of the node, under the lock ------------------------------------------------------

    def _carry_out(self) -> list[Action]:
        """Send what is to be sent, do what the node asks for, and return what is left for after the lock."""
        node = self._node
        for session in node.ready():
            if (pipe := self._pipes.get(session)) is not None:
                self._flush(session, pipe)
        actions = node.actions()
        for action in actions:
            if type(action) is Dial:
                if not self._stopping:
                    self._start(self._call, action.peer)
            elif type(action) is Close and (pipe := self._pipes.pop(action.session, None)) is not None:
                self._flush(action.session, pipe)
                self._blocked.pop(action.session, None)
                pipe.shutdown()
        deadline = node.next_deadline()
        if deadline is not None and deadline < self._pump_until:
            self._pump_until = deadline
            os.eventfd_write(self._wake, 1)
        return actions

    def _flush(self, session: Session, pipe: Pipe) -> None:
        while pipe.flush():
            data = session.data_to_send(clock.now(), _CHUNK)
            if not data:
                self._blocked.pop(session, None)
                return
            pipe.offer(data)
        if session not in self._blocked:
            self._blocked[session] = pipe
            self._pump_until = 0.0
            os.eventfd_write(self._wake, 1)

    def _report(self, actions: list[Action]) -> None:
        """After the lock: what goes to the bus and to the log."""
        changed = False
        for action in actions:
            if type(action) is Received:
                self._deliver(action.key, action.payload, action.priority < BULK)
            elif type(action) is LinksChanged:
                changed = True
            elif type(action) is Note:
                _log.log(logging.WARNING if action.problem else logging.INFO, "%s", action.text)
        if changed:
            self._changed()

    # -- threads -----------------------------------------------------------------------------------

    def _start(self, target: Callable[..., None], *arguments: object) -> None:
        thread = threading.Thread(target=self._reader, args=(target, *arguments), name="mesh-link", daemon=True)
        self._threads.add(thread)
        thread.start()

    def _reader(self, target: Callable[..., None], *arguments: object) -> None:
        try:
            target(*arguments)
        finally:
            self._threads.discard(threading.current_thread())

    def _call(self, peer: str) -> None:
        """Dial a neighbour and read from it until the connection ends."""
        try:
            pipe = self._dial(peer)
        except OSError as error:
            with self._lock:
                self._node.dial_failed(peer, describe(error), clock.now())
                actions = self._carry_out()
            self._report(actions)
            return
        with self._lock:
            session = self._node.dialled(peer, clock.now())
            self._pipes[session] = pipe
            actions = self._carry_out()
        self._report(actions)
        self._read(session, pipe)

    def _read(self, session: Session, pipe: Pipe) -> None:
        reason = "closed by the other end"
        try:
            while data := pipe.read():
                with self._lock:
                    self._node.receive(session, data, clock.now())
                    actions = self._carry_out()
                self._report(actions)
        except OSError as error:
            reason = describe(error)
        with self._lock:
            self._node.transport_down(session, pipe.fault or reason, clock.now())
            actions = self._carry_out()
            self._pipes.pop(session, None)
            self._blocked.pop(session, None)
            pipe.close()
        self._report(actions)

    def _accept(self, listener: Listener) -> None:
        try:
            pipe = listener.accept()
        except OSError:
            return
        with self._lock:
            session = self._node.accepted(clock.now())
            if session is None or self._stopping:
                pipe.close()
            else:
                self._pipes[session] = pipe
                self._start(self._read, session, pipe)
            actions = self._carry_out()
        self._report(actions)

    def _run(self) -> None:
        """The pump: timers, callers, and sockets that were full."""
        while True:
            with self._lock:
                if self._stopping:
                    return
                self._node.handle_timer(clock.now())
                actions = self._carry_out()
                deadline = self._node.next_deadline()
                self._pump_until = clock.now() + 3600.0 if deadline is None else deadline
                blocked = dict(self._blocked)
            self._report(actions)
            timeout = max(0.0, self._pump_until - clock.now())
            readers: list[int | Listener] = [self._wake, *self._listeners]
            try:
                readable, writable, _ = select.select(readers, [*blocked.values()], [], timeout)
            except (OSError, ValueError):
                continue  # A blocked pipe was closed meanwhile.
            if self._wake in readable:
                with contextlib.suppress(BlockingIOError):
                    os.eventfd_read(self._wake)
            for listener in self._listeners:
                if listener in readable:
                    self._accept(listener)
            if writable:
                with self._lock:
                    for session, pipe in blocked.items():
                        if pipe in writable and session in self._blocked:
                            self._flush(session, pipe)
