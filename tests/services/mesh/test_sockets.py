"""The thread that reads, accepts and keeps time for a mesh, where the process has no descriptor left."""

import contextlib
import errno
import logging
import os
import socket
import threading
from collections import Counter
from collections.abc import Iterator
from types import SimpleNamespace
from typing import cast

import pytest
from conftest import wait_until

from services.mesh import sockets
from services.mesh.core.link.calls import Caller
from services.mesh.links.pipe import Pipe
from services.mesh.mesh import Mesh
from services.mesh.sockets import Sockets
from swarm import clock
from swarm.bus.protocol import BusLike
from swarm.process.locked_runtime import LockedRuntime

PAUSE = 0.02


class FullListener:
    """A listener with a caller in its queue, which cannot be accepted until a descriptor is free."""

    def __init__(self) -> None:
        self.free = False
        self.tries = 0
        self.near, self.far = socket.socketpair()
        self._waiting = os.eventfd(1)

    def fileno(self) -> int:
        return self._waiting

    def accept(self) -> Pipe:
        self.tries += 1
        if not self.free:
            raise OSError(errno.EMFILE, "Too many open files")
        os.eventfd_read(self._waiting)
        return Pipe(self.near)

    def close(self) -> None:
        os.close(self._waiting)
        for sock in (self.near, self.far):
            sock.close()


class MeshWithoutRoom:
    """A mesh that notes its callers and takes none, and whom it could not call."""

    def __init__(self) -> None:
        self.callers: list[Caller] = []
        self.failed: list[tuple[str, str]] = []

    def dial_failed(self, peer: str, reason: str) -> None:
        self.failed.append((peer, reason))

    def accepted(self, caller: Caller) -> None:
        self.callers.append(caller)

    def carry_out(self) -> None:
        """Nothing is to be done."""

    due = stop = carry_out


@pytest.fixture
def listener() -> Iterator[FullListener]:
    with contextlib.closing(FullListener()) as made:
        yield made


@pytest.mark.parametrize("epoll_works", [True, False])
def test_mesh_without_descriptors_waits_keeps_time_and_accepts_when_one_is_free(
    listener: FullListener, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, epoll_works: bool
) -> None:
    monkeypatch.setattr(sockets, "_PAUSE_EXHAUSTED", PAUSE)
    if not epoll_works:
        monkeypatch.setattr(sockets.select, "epoll", lambda: (_ for _ in ()).throw(OSError(errno.EMFILE, "none")))
    runtime = LockedRuntime(cast(BusLike, None), Counter(), logging.getLogger("mesh"))
    tested, mesh = Sockets(runtime, [listener], dial=lambda peer: Pipe(listener.far)), MeshWithoutRoom()
    times: list[float] = []
    start = clock.now()
    runtime.at(start + 2.5 * PAUSE, lambda: times.append(clock.now()))
    # The mesh has no timers of its own.
    tested.wake(float("inf"))
    tested.start(cast(Mesh, mesh))
    wait_until(lambda: times and listener.tries >= 3)
    assert listener.tries <= (clock.now() - start) / PAUSE + 1
    listener.free = True
    wait_until(lambda: mesh.callers)
    assert len(mesh.callers) == 1
    assert runtime.counters["calls_not_accepted"] == listener.tries - 1
    tested.stop()
    (warning,) = caplog.records
    assert warning.getMessage() == "robots that call cannot be accepted: too many open files; trying every 0.02 s"


def test_a_call_for_which_the_process_gets_no_thread_has_failed_and_the_next_one_is_made(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A unit may have 32 tasks: the mesh of a robot that calls thirty absent ones ended, again and again."""
    runtime = LockedRuntime(cast(BusLike, None), Counter(), logging.getLogger("mesh"))

    def absent(peer: str) -> Pipe:
        raise OSError(errno.EHOSTDOWN, "Host is down")

    tested, mesh = Sockets(runtime, [], dial=absent), MeshWithoutRoom()
    tested.wake(float("inf"))
    tested.start(cast(Mesh, mesh))

    def none_is_left(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", none_is_left)
        runtime.entry(tested.dial)("r1")
    assert mesh.failed == [("r1", "can't start new thread")]
    runtime.entry(tested.dial)("r2")
    wait_until(lambda: mesh.failed[1:] == [("r2", "host is down")])
    tested.stop()


class HangingDial(threading.Thread):
    """A call that does not end, on a clock of its own."""

    now = 0.0

    def join(self, timeout: float | None = None) -> None:
        assert timeout is not None
        HangingDial.now += timeout


def test_a_mesh_that_calls_many_absent_robots_ends_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """It waited 2 s for each call, so that systemd killed it after 5 s."""
    runtime = LockedRuntime(cast(BusLike, None), Counter(), logging.getLogger("mesh"))
    tested = Sockets(runtime, [], dial=lambda peer: Pipe(socket.socket()))
    tested.wake(float("inf"))
    tested.start(cast(Mesh, MeshWithoutRoom()))
    tested._dials = {HangingDial() for _ in range(5)}
    monkeypatch.setattr(sockets, "clock", SimpleNamespace(now=lambda: HangingDial.now))
    tested.stop()
    assert HangingDial.now == sockets._JOIN_TIMEOUT
