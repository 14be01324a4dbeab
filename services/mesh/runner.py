"""The threads around a node: one that reads, accepts and keeps time, and a short-lived one for each dialling.

Whoever makes the node produce bytes sends them at once, be it the reading thread or Zenoh's callback: no hand-over
between threads delays a message. The node runs under one lock, in which nothing waits. What is to be published on the
bus is published after the lock is released, by the reading thread, so each link's messages keep their order. One
reading thread costs less than one for each link, since what arrives together is handled in one go: lockstep on a full
graph of six robots over 30 ms took 34.9 ms an iteration instead of 37.1 (two cores, both under other load).
"""

import contextlib
import logging
import os
import select
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, TypeVar

from services.mesh.core.actions import Action, Close, Dial, LinksChanged, LogLine, Write
from services.mesh.core.events import Received
from services.mesh.core.link.clock import ClockState
from services.mesh.core.link.session import Session
from services.mesh.core.node import MeshNode
from services.mesh.core.overlays.robot_overlays import RobotOverlays
from services.mesh.links.pipe import Pipe, describe
from swarm import clock
from swarm.messages import EchoRequest, HoldLink, LinkState

_CHUNK = 4096
"""Bytes taken from a session at a time; what is taken can no longer be overtaken."""

_NEVER = float("inf")

T = TypeVar("T")

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


class Watched:
    """What the reading thread waits for, by descriptor. Made when it changes: a robot with five neighbours is woken 130
    times a second, and would else ask each of them every time."""

    __slots__ = ("_blocked", "_calm", "_readers", "pipes", "restless")

    def __init__(self, always: Sequence[int], pipes: Mapping[Session, Pipe], blocked: Mapping[Session, Pipe]) -> None:
        """`always`: descriptors besides the pipes'; `blocked`: pipes whose socket is full."""
        self.pipes = {pipe.fileno(): (session, pipe) for session, pipe in pipes.items()}
        self.restless = {fd: found for fd, found in self.pipes.items() if found[1].restless}
        self._readers = [*always, *(fd for fd in self.pipes if fd not in self.restless)]
        self._blocked = [pipe.fileno() for pipe in blocked.values()]
        self._calm: select.epoll | None = None
        """Where nothing else is waited for than bytes, all are known to the kernel, which is a sixth of what a wake
        costs. It counts in ms."""
        if not self.restless and not self._blocked:
            self._calm = select.epoll()
            for fd in self._readers:
                self._calm.register(fd, select.EPOLLIN)

    def wait(self, now: float, deadline: float) -> tuple[list[int], list[int]]:
        """Wait for the first of: bytes, room in a full socket, a change of a restless pipe, the deadline. Gives what is
        readable, and writable."""
        wanted = []
        for fd, (_, pipe) in self.restless.items():
            if (change := pipe.next_change(now)) is not None:
                deadline = min(deadline, change)
            if pipe.wants_read(now):
                wanted.append(fd)
        timeout = None if deadline == _NEVER else max(0.0, deadline - now)
        if self._calm is not None:
            return [fd for fd, _ in self._calm.poll(timeout, len(self._readers))], []
        readable, writable, _ = select.select([*self._readers, *wanted], self._blocked, [], timeout)
        return readable, writable

    def close(self) -> None:
        """It is waited for no more."""
        if self._calm is not None:
            self._calm.close()


class MeshRunner:
    """Runs one node until `stop`."""

    def __init__(
        self,
        node: MeshNode,
        *,
        listeners: Sequence[Listener],
        dial: Callable[[str], Pipe],
        deliver: Callable[[Sequence[Received]], None],
        changed: Callable[[], None],
        keep: Callable[[], None],
    ) -> None:
        """`dial(peer)` connects or raises OSError. Called without the lock: `deliver(messages)` for what came
        in, `changed()` when a link did, `keep()` when there is another topology to be kept."""
        self._node = node
        self._listeners = {each.fileno(): each for each in listeners}
        self._dial = dial
        self._deliver = deliver
        self._changed = changed
        self._keep = keep
        self._lock = threading.Lock()
        self._pipes: dict[Session, Pipe] = {}
        self._blocked: dict[Session, Pipe] = {}
        self._other_pipes = True
        """Whether these have changed since the reading thread looked at them."""
        self._ended: list[Pipe] = []
        self._dials: set[threading.Thread] = set()
        self._stopping = False
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._always = [self._wake, *self._listeners]
        self._watched = Watched(self._always, {}, {})
        self._deadline = 0.0
        self._turned = False
        self._thread = threading.Thread(target=self._run, name="mesh")

    def start(self) -> None:
        """Begin to dial and to listen."""
        self._thread.start()

    def publish(self, source: int | None, key: str, payload: bytes) -> None:
        """A sample of the own bus, `source` as of `MeshNode.publish`. Zenoh's thread may call it; it never waits for a
        socket."""
        with self._lock:
            self._node.publish(source, key, payload, clock.now())
            actions = self._carry_out()
        self._report(actions)

    def ask(self, step: Callable[[RobotOverlays, float], object]) -> None:
        """Something for the overlays; like `publish`."""
        with self._lock:
            self._node.ask(step, clock.now())
            actions = self._carry_out()
        self._report(actions)

    def look(self, question: Callable[[RobotOverlays, float], T]) -> T:
        """Something the overlays know."""
        with self._lock:
            return question(self._node.overlays, clock.now())

    def ping(self, request: EchoRequest) -> None:
        """Measure a link; what comes of it is delivered."""
        with self._lock:
            self._node.ping(request, clock.now())
            actions = self._carry_out()
        self._report(actions)

    def hold(self, request: HoldLink) -> None:
        """Have no link with a neighbour for a while."""
        with self._lock:
            self._node.hold(request, clock.now())
            actions = self._carry_out()
        self._report(actions)

    def links(self) -> tuple[LinkState, ...]:
        """All links as they are."""
        with self._lock:
            return self._node.links()

    def clashes(self) -> dict[str, str]:
        """Names that two robots have."""
        with self._lock:
            return self._node.clashes(clock.now())

    def clock(self) -> ClockState:
        """The mesh clock now."""
        with self._lock:
            return self._node.clock(clock.now())

    def turned(self) -> bool:
        """Whether the reading thread has gone round since the last call. Wakes it, so that an idle one will have."""
        turned, self._turned = self._turned, False
        self._wake_up()
        return turned

    def stop(self) -> None:
        """Say goodbye to the neighbours and end all threads."""
        with self._lock:
            self._stopping = True
            self._node.leave(clock.now())
            actions = self._carry_out()
            self._node.close(clock.now())
            actions += self._carry_out()
            self._wake_up()
        self._report(actions)
        self._thread.join()
        for thread in tuple(self._dials):
            thread.join(_JOIN_TIMEOUT)
        for pipe in self._ended:
            pipe.close()
        self._watched.close()
        os.close(self._wake)

    # -- one step of the node, under the lock ----------------------------------------------------------------

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
                    thread = threading.Thread(target=self._call, args=(action.peer,), name="dial", daemon=True)
                    self._dials.add(thread)
                    thread.start()
            elif type(action) is Close and (pipe := self._pipes.pop(action.session, None)) is not None:
                self._flush(action.session, pipe)
                self._blocked.pop(action.session, None)
                pipe.shutdown()
                self._ended.append(pipe)
                self._look_again()
        deadline, before = node.next_deadline(), self._deadline
        self._deadline = deadline
        if deadline < before and threading.get_ident() != self._thread.ident:
            self._wake_up()
        return actions

    def _flush(self, session: Session, pipe: Pipe) -> None:
        calm = not pipe.restless
        while pipe.flush():
            data = session.data_to_send(clock.now(), _CHUNK)
            if not data:
                if self._blocked.pop(session, None) is not None:
                    self._other_pipes = True
                break
            pipe.offer(data)
        else:
            if session not in self._blocked:
                self._blocked[session] = pipe
                self._look_again()
        if calm and pipe.restless:
            self._look_again()

    def _look_again(self) -> None:
        """The reading thread waits for other descriptors from now on."""
        self._other_pipes = True
        self._wake_up()

    def _wake_up(self) -> None:
        os.eventfd_write(self._wake, 1)

    def _report(self, actions: list[Action]) -> None:
        """After the lock: what goes to the bus and to the log."""
        if not actions:
            return
        changed = False
        received: list[Received] = []
        for action in actions:
            if type(action) is Received:
                received.append(action)
            elif type(action) is Write:
                self._keep()  # before the bus hears of it
            elif type(action) is LinksChanged:
                changed = True
            elif type(action) is LogLine:
                _log.log(logging.WARNING if action.problem else logging.INFO, "%s", action.text)
        if received:
            self._deliver(received)
        if changed:
            self._changed()

    # -- dialling --------------------------------------------------------------------------------------------

    def _call(self, peer: str) -> None:
        try:
            pipe = self._dial(peer)
        except OSError as error:
            pipe, reason = None, describe(error)
        with self._lock:
            self._dials.discard(threading.current_thread())
            if self._stopping:
                if pipe is not None:
                    pipe.close()
                return
            if pipe is None:
                self._node.dial_failed(peer, reason, clock.now())
            else:
                self._pipes[self._node.dialled(peer, clock.now())] = pipe
                self._look_again()
            actions = self._carry_out()
        self._report(actions)

    # -- the reading thread ----------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            with self._lock:
                if self._stopping:
                    return
                ended, self._ended = self._ended, []
                if self._other_pipes:
                    self._watched.close()
                    self._watched = Watched(self._always, self._pipes, self._blocked)
                    self._other_pipes = False
                deadline = self._deadline
            self._turned = True
            for pipe in ended:
                pipe.close()
            self._wait(self._watched, deadline)
            # Timers come after what has arrived: a process that was stopped for a moment must not take its own
            # absence for the others' silence.
            if clock.now() >= self._deadline:
                with self._lock:
                    self._node.handle_timer(clock.now())
                    actions = self._carry_out()
                self._report(actions)

    def _wait(self, watched: Watched, deadline: float) -> None:
        """Wait for the first of: bytes, callers, room in a full socket, the deadline; and handle it."""
        readable, writable = watched.wait(clock.now(), deadline)
        looked: list[tuple[Session, Pipe]] = []
        for fd in readable:
            if (found := watched.pipes.get(fd)) is not None:
                looked.append(found)
            elif (listener := self._listeners.get(fd)) is not None:
                self._accept(listener)
            else:
                with contextlib.suppress(BlockingIOError):
                    os.eventfd_read(fd)
        now = clock.now()
        for _, pipe in looked:
            pipe.read(now)
        if watched.restless:
            looked += [found for fd, found in watched.restless.items() if fd not in readable]
        arrivals: list[tuple[Session, Pipe, bytes]] = []
        for session, pipe in looked:
            while (data := pipe.take(now)) is not None:
                arrivals.append((session, pipe, data))
                if not data:
                    break
        if arrivals or writable:
            with self._lock:
                now = clock.now()
                for session, pipe, data in arrivals:
                    if data:
                        self._node.receive(session, data, now)
                    else:
                        reason = pipe.fault or "closed by the other end"
                        self._node.transport_down(session, reason, now)
                        for other in self._pipes.values():
                            if other is not pipe:
                                other.nudge()
                for fd in writable:
                    session, pipe = watched.pipes[fd]
                    if session in self._blocked:
                        self._flush(session, pipe)
                actions = self._carry_out()
            self._report(actions)

    def _accept(self, listener: Listener) -> None:
        try:
            pipe = listener.accept()
        except OSError:
            return
        with self._lock:
            session = self._node.accepted(clock.now(), pipe.caller)
            if session is None:
                pipe.close()
            else:
                self._pipes[session] = pipe
                self._other_pipes = True
            actions = self._carry_out()
        self._report(actions)
