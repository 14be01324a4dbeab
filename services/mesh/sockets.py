"""A mesh's transport over sockets: one thread that reads, accepts and keeps time, and a short-lived one for each
dialling.

One reading thread costs less than one for each link, since what arrives together is handled in one go: lockstep on a
full graph of six robots over 30 ms took 34.9 ms an iteration instead of 37.1 (two cores, both under other load).
"""

import contextlib
import errno
import os
import select
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

from services.mesh.core.link.session import Session
from services.mesh.links.pipe import Pipe, describe
from services.mesh.mesh import CLOSED, Mesh
from swarm import clock
from swarm.process.locked_runtime import LockedRuntime

_CHUNK = 4096
"""Bytes taken from a session at a time; what is taken can no longer be overtaken."""

_NEVER = float("inf")

_JOIN_TIMEOUT = 2.0
"""Seconds to wait at the end for threads that may hang in a dial, for all of them together: systemd waits for 5 s."""

_EXHAUSTED = frozenset((errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM))
"""Errors of accept() after which the caller still stands in the queue, so that the listener stays readable."""

_PAUSE_EXHAUSTED = 0.5
"""Seconds without listening after such an error: waiting for the listener would return at once and use all CPU time."""


class Listener(Protocol):
    """A listener for neighbours of this robot."""

    def fileno(self) -> int:
        """Return the descriptor that `select` waits for."""

    def accept(self) -> Pipe:
        """Return the next caller; raises OSError where it has gone already, or where the process has no descriptor
        left."""

    def close(self) -> None:
        """Stop listening."""


class Watched:
    """The descriptors for which the reading thread waits. A new one is made when they change: a robot with five
    neighbours is woken 130 times a second, and would otherwise ask each of them every time."""

    def __init__(self, always: Sequence[int], pipes: Mapping[Session, Pipe], blocked: Mapping[Session, Pipe]) -> None:
        """`always`: descriptors besides the pipes'; `blocked`: pipes whose socket is full."""
        self.pipes = {pipe.fileno(): (session, pipe) for session, pipe in pipes.items()}
        self.restless = {fd: found for fd, found in self.pipes.items() if found[1].restless}
        self._readers = [*always, *(fd for fd in self.pipes if fd not in self.restless)]
        self._blocked = [pipe.fileno() for pipe in blocked.values()]
        self._calm: select.epoll | None = None
        """The kernel keeps the list of the descriptors where only bytes are waited for: handing it over each time is a
        sixth of what a wake costs. Its time-outs are whole ms."""
        if not self.restless and not self._blocked:
            # It needs a descriptor of its own; where none is free, select has to do.
            with contextlib.suppress(OSError):
                self._calm = select.epoll()
        if self._calm is not None:
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
        """Give the kernel's list of descriptors back."""
        if self._calm is not None:
            self._calm.close()


class Sockets:
    """The connections of one mesh, until `stop`; see `services.mesh.surroundings.Transport`. What is called by the
    mesh runs under the runtime's lock."""

    def __init__(self, runtime: LockedRuntime, listeners: Sequence[Listener], dial: Callable[[str], Pipe]) -> None:
        """`dial(peer)` connects or raises OSError."""
        self._runtime = runtime
        self._listeners = {each.fileno(): each for each in listeners}
        self._connect = dial
        self._mesh: Mesh
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
        entry = runtime.entry
        self._dialled = entry(self._on_dialled)
        self._accepted = entry(self._on_accepted)
        self._exhausted = entry(self._on_exhausted)
        self._received = entry(self._on_received)
        self._look = entry(self._on_look)

    def start(self, mesh: Mesh) -> None:
        """Begin to dial and to listen."""
        self._mesh = mesh
        self._due = self._runtime.entry(mesh.due)
        self._thread.start()

    def turned(self) -> bool:
        """Return whether the reading thread has gone round since the last call. An idle one does once a second, since
        the mesh reports so often."""
        turned, self._turned = self._turned, False
        return turned

    def stop(self) -> None:
        """Say goodbye to the neighbours and end all threads."""
        self._runtime.entry(self._on_stop)()
        self._thread.join()
        end = clock.now() + _JOIN_TIMEOUT
        for thread in tuple(self._dials):
            thread.join(max(0.0, end - clock.now()))
        for pipe in self._ended:
            pipe.close()
        self._watched.close()
        os.close(self._wake)

    # -- what the mesh calls, under the lock -------------------------------------------------------------------

    def dial(self, peer: str) -> None:
        """Connect on a thread of its own."""
        if not self._stopping:
            thread = threading.Thread(target=self._call, args=(peer,), name="dial", daemon=True)
            self._dials.add(thread)
            try:
                thread.start()
            except RuntimeError as error:  # the unit's TasksMax, or no memory: an absent robot keeps a thread for 10 s
                self._dials.discard(thread)
                self._runtime.soon(self._mesh.dial_failed, peer, str(error))

    def flush(self, session: Session) -> None:
        """Write what the session has to send, until its socket is full."""
        if (pipe := self._pipes.get(session)) is not None:
            self._flush(session, pipe)

    def close(self, session: Session) -> None:
        """Write what goes without waiting and end the connection."""
        if (pipe := self._pipes.pop(session, None)) is not None:
            self._flush(session, pipe)
            self._blocked.pop(session, None)
            pipe.shutdown()
            self._ended.append(pipe)
            self._look_again()

    def supervise(self, session: Session, seconds: float) -> None:
        """Tell the radio, on a thread of its own, how long a silent connection is kept."""
        if (pipe := self._pipes.get(session)) is not None and pipe.limit is not None:
            with contextlib.suppress(RuntimeError):  # no thread is left: a link works without the limit, too
                threading.Thread(target=pipe.limit, args=(seconds,), name="limit", daemon=True).start()

    def wake(self, deadline: float) -> None:
        """Have the reading thread wait no longer than this."""
        before, self._deadline = self._deadline, deadline
        if deadline < before and threading.get_ident() != self._thread.ident:
            self._wake_up()

    # -- under the lock ----------------------------------------------------------------------------------------

    def _flush(self, session: Session, pipe: Pipe) -> None:
        calm = not pipe.restless
        while pipe.flush():
            now = clock.now()
            data = session.data_to_send(now, _CHUNK)
            if not data:
                self._mesh.flushed(session, now)
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

    def _on_stop(self) -> None:
        self._stopping = True
        self._mesh.stop()
        self._wake_up()

    def _on_dialled(self, peer: str, pipe: Pipe | None, reason: str) -> None:
        self._dials.discard(threading.current_thread())
        if self._stopping:
            if pipe is not None:
                pipe.close()
        elif pipe is None:
            self._mesh.dial_failed(peer, reason)
        else:
            self._pipes[self._mesh.dialled(peer)] = pipe
            self._look_again()
            self._mesh.carry_out()

    def _on_accepted(self, pipe: Pipe) -> None:
        session = self._mesh.accepted(pipe.caller)
        if session is None:
            pipe.close()
        else:
            self._pipes[session] = pipe
            self._other_pipes = True
        self._mesh.carry_out()

    def _on_exhausted(self, reason: str) -> None:
        """Accept nobody for a while. Links, timers and dials go on."""
        self._runtime.counters["calls_not_accepted"] += 1
        if self._runtime.counters["calls_not_accepted"] == 1:
            self._runtime.log.warning(
                "robots that call cannot be accepted: %s; trying every %g s", reason, _PAUSE_EXHAUSTED
            )
        self._always = [self._wake]
        self._other_pipes = True
        self._runtime.at(self._runtime.now + _PAUSE_EXHAUSTED, self._listen_again)

    def _listen_again(self) -> None:
        self._always = [self._wake, *self._listeners]
        self._other_pipes = True

    def _on_received(self, arrivals: list[tuple[Session, bytes | str]], writable: list[tuple[Session, Pipe]]) -> None:
        for session, pipe in writable:
            if session in self._blocked:
                self._flush(session, pipe)
        if gone := {session for session, data in arrivals if type(data) is str}:
            for session, pipe in self._pipes.items():
                if session not in gone:
                    pipe.nudge()
        self._mesh.received(arrivals)

    def _on_look(self) -> list[Pipe]:
        """Return pipes that are to be closed, now that they are waited for no more."""
        ended, self._ended = self._ended, []
        if self._other_pipes:
            self._watched.close()
            self._watched = Watched(self._always, self._pipes, self._blocked)
            self._other_pipes = False
        return ended

    # -- threads -----------------------------------------------------------------------------------------------

    def _call(self, peer: str) -> None:
        pipe, reason = None, ""
        try:
            pipe = self._connect(peer)
        except OSError as error:
            reason = describe(error)
        except ValueError as error:  # a name that no host can have
            reason = str(error)
        self._dialled(peer, pipe, reason)

    def _run(self) -> None:
        runtime = self._runtime
        while not self._stopping:
            for pipe in self._look():
                pipe.close()
            self._turned = True
            self._wait(self._watched, min(self._deadline, runtime.next_time))
            # Timers come after what has arrived: a process that was stopped for a moment must not take its own
            # absence for the others' silence.
            now = clock.now()
            if now >= self._deadline:
                self._due()
            if now >= runtime.next_time:
                runtime.call_due()

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
        arrivals: list[tuple[Session, bytes | str]] = []
        for session, pipe in looked:
            while (data := pipe.take(now)) is not None:
                arrivals.append((session, data or pipe.fault or CLOSED))
                if not data:
                    break
        if arrivals or writable:
            self._received(arrivals, [watched.pipes[fd] for fd in writable])

    def _accept(self, listener: Listener) -> None:
        try:
            pipe = listener.accept()
        except OSError as error:
            if error.errno in _EXHAUSTED:
                self._exhausted(describe(error))
            return
        self._accepted(pipe)
