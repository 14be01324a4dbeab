"""The short way between mesh and apps: datagrams, and what a sender is told where they do not go."""

import select
import socket
import threading
from pathlib import Path

import pytest

from swarm.bus import batch
from swarm.bus.lane import MESH, Lane, of_app
from swarm.errors import BusError, LocalError

PARTS = [("swarm/r1/app/x/sync/a", b"1"), ("swarm/r2/app/x/sync/a", b"")]


def test_what_is_sent_arrives(runtime: Path) -> None:
    mesh, app = Lane(runtime, MESH), Lane(runtime, of_app("x"))
    assert mesh.take() is None
    assert app.send(MESH, PARTS)
    assert select.select([mesh], [], [], 60)[0] == [mesh]
    data = mesh.take()
    assert data is not None
    assert list(batch.unpack(data)) == PARTS
    assert mesh.take() is None
    assert mesh.send(of_app("x"), PARTS)
    assert app.wait() == batch.pack(PARTS)
    for lane in (mesh, app):
        lane.close()
    assert list(runtime.iterdir()) == []


def test_a_sender_is_told_that_nobody_listens(runtime: Path) -> None:
    app = Lane(runtime, of_app("x"))
    assert not app.send(MESH, PARTS)
    # As a killed mesh leaves it; the next one takes its place.
    killed = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    killed.bind(str(runtime / MESH))
    killed.close()
    assert not app.send(MESH, PARTS)
    mesh = Lane(runtime, MESH)
    assert app.send(MESH, PARTS)
    mesh.close()
    assert not app.send(MESH, PARTS)
    app.close()


def test_a_sender_never_waits_for_who_does_not_read(runtime: Path) -> None:
    mesh, app = Lane(runtime, MESH), Lane(runtime, of_app("x"))
    count = 0
    while app.send(MESH, PARTS):
        count += 1
    assert 0 < count < 10_000
    assert not app.send(MESH, [("k", bytes(1 << 20))]), "more than a datagram holds"
    while mesh.take() is not None:
        count -= 1
    assert count == 0
    assert app.send(MESH, PARTS)
    for lane in (mesh, app):
        lane.close()


def test_who_waits_comes_back_when_woken(runtime: Path) -> None:
    app = Lane(runtime, of_app("x"))
    app.wake()
    assert app.wait() is None
    got: list[bytes | None] = []
    thread = threading.Thread(target=lambda: got.append(app.wait()))
    thread.start()
    app.wake()
    thread.join(60)
    assert got == [None]
    assert app.send(of_app("x"), PARTS)
    app.wake()
    assert app.wait() == batch.pack(PARTS)
    app.close()


def test_waking_does_not_wait_for_who_does_not_read(runtime: Path) -> None:
    app = Lane(runtime, of_app("x"))
    while app.send(of_app("x"), PARTS):
        pass
    app.wake()
    assert app.wait() == batch.pack(PARTS)
    app.close()


def test_where_there_can_be_none(runtime: Path) -> None:
    with pytest.raises(LocalError, match=r"nowhere/mesh\.lane: No such file or directory"):
        Lane(runtime / "nowhere", MESH)
    with pytest.raises(BusError, match="a Unix socket's path holds at most"):
        Lane(runtime / ("x" * 100), MESH)
