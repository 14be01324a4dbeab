"""Cuts of a run that come while the radio or a mesh is being restarted."""

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest

from services.mesh.links import slots
from sim.control.link_cuts import SOCKET, DueCuts
from sim.disturbances import Cut
from swarm.messages.codec import decode

DUE = Cut("r0", "r1", 5.0, 3.0)
NOW = 100.0


@contextlib.contextmanager
def listening(path: Path, kind: int) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, kind) as sock:
        sock.bind(str(path))
        if kind == socket.SOCK_SEQPACKET:
            sock.listen()
        sock.settimeout(10.0)
        yield sock
    path.unlink()


@contextlib.contextmanager
def mesh(run_dir: Path, name: str) -> Iterator[socket.socket]:
    (run_dir / name).mkdir(exist_ok=True)
    with listening(run_dir / name / SOCKET, socket.SOCK_DGRAM) as sock:
        yield sock


def told(radio: socket.socket) -> slots.RadioCut:
    with radio.accept()[0] as connection:
        return decode(slots.RadioCut, connection.recv(slots.MAX_PACKET), "radio")


@pytest.fixture
def cuts(runtime: Path) -> DueCuts:
    found = DueCuts(runtime)
    found.add(DUE, NOW)
    return found


@pytest.mark.parametrize("killed", [True, False])
def test_a_cut_waits_for_the_radio_and_ends_when_it_would_have_ended(
    cuts: DueCuts, runtime: Path, killed: bool
) -> None:
    path = runtime / slots.RADIO_SOCKET
    if killed:  # it leaves its socket behind
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as left:
            left.bind(str(path))
    cuts.do(NOW)
    cuts.do(NOW + 0.5)
    assert [due for due, _ in cuts.waiting] == [DUE]
    path.unlink(missing_ok=True)
    with listening(path, socket.SOCK_SEQPACKET) as radio:
        cuts.do(NOW + 1.0)
        assert told(radio) == slots.RadioCut("r0", "r1", 2.0)
    assert (cuts.waiting, cuts.failed) == ([], [])


def test_a_cut_waits_until_the_meshes_at_both_ends_are_there(cuts: DueCuts, runtime: Path) -> None:
    with mesh(runtime, "r0") as here:
        cuts.do(NOW)
        assert msgpack.unpackb(here.recv(1000)) == {"cut": "r1", "seconds": 3.0}
        with mesh(runtime, "r1") as there:
            cuts.do(NOW + 1.0)
            assert msgpack.unpackb(here.recv(1000)) == {"cut": "r1", "seconds": 2.0}
            assert msgpack.unpackb(there.recv(1000)) == {"cut": "r0", "seconds": 2.0}
    assert (cuts.waiting, cuts.failed) == ([], [])


def test_a_cut_that_is_over_before_the_radio_is_back_is_named(cuts: DueCuts, runtime: Path) -> None:
    for seconds in (0.0, 2.9, 3.1):
        cuts.do(NOW + seconds)
    assert cuts.waiting == []
    (sentence,) = cuts.failed
    assert sentence.startswith("--cut r0-r1@5s,3s: not cut: the mesh of r0 is not running at this moment")
