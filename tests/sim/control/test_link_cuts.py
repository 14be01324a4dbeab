"""Cuts of a run: those who are there are told, and a file tells those that are being restarted."""

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest

from services.mesh.links import slots
from services.mesh.links.sim import AIR_SOCKET, cuts_in
from sim.control.link_cuts import cut_link
from swarm import clock
from swarm.errors import LocalError
from swarm.messages.codec import decode

LINK = frozenset(("r0", "r1"))


@contextlib.contextmanager
def listening(path: Path, kind: int) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, kind) as sock:
        sock.bind(str(path))
        if kind == socket.SOCK_SEQPACKET:
            sock.listen()
        sock.settimeout(60.0)
        yield sock
    path.unlink()


@pytest.fixture
def run_dir(runtime: Path) -> Path:
    for name in ("r0", "r1"):
        (runtime / name).mkdir()
    return runtime


def left(run_dir: Path) -> float:
    """Seconds that the cut still lasts."""
    return cuts_in(run_dir)[LINK] - clock.now()


@pytest.mark.parametrize("killed", [True, False])
def test_a_cut_is_kept_for_a_radio_that_is_being_restarted(run_dir: Path, killed: bool) -> None:
    path = run_dir / slots.RADIO_SOCKET
    if killed:  # it leaves its socket behind
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as radio:
            radio.bind(str(path))
    cut_link(run_dir, "r1", "r0", 60.0)
    assert left(run_dir) == pytest.approx(60.0, abs=10.0)
    path.unlink(missing_ok=True)
    with listening(path, socket.SOCK_SEQPACKET) as radio:
        cut_link(run_dir, "r0", "r1", 20.0)
        with radio.accept()[0] as connection:
            told = decode(slots.RadioCut, connection.recv(slots.MAX_PACKET), "radio")
    assert told.seconds == pytest.approx(60.0, abs=10.0)  # the first cut still holds


def test_a_cut_is_told_to_the_mesh_that_is_there_and_kept_for_the_other_one(run_dir: Path) -> None:
    with listening(run_dir / "r0" / AIR_SOCKET, socket.SOCK_DGRAM) as mesh:
        cut_link(run_dir, "r1", "r0", 60.0)
        assert msgpack.unpackb(mesh.recv(1000)) == {"cut": "r1", "seconds": 60.0}
        assert left(run_dir) == pytest.approx(60.0, abs=10.0)
        cut_link(run_dir, "r0", "r1", 0.0)
        assert msgpack.unpackb(mesh.recv(1000)) == {"cut": "r1", "seconds": 0.0}
    assert cuts_in(run_dir) == {}


def test_a_shorter_cut_leaves_a_longer_one_as_it_is(run_dir: Path) -> None:
    cut_link(run_dir, "r0", "r1", 60.0)
    before = cuts_in(run_dir)
    cut_link(run_dir, "r1", "r0", 1.0)
    assert cuts_in(run_dir) == before


def test_a_cut_of_a_robot_that_is_not_there_is_refused(run_dir: Path) -> None:
    with pytest.raises(LocalError, match="not cut: there is no robot r9 in "):
        cut_link(run_dir, "r0", "r9", 1.0)


@pytest.mark.parametrize("text", ["", "soon", "1.0 2.0"])
def test_a_file_that_tells_of_no_cut_is_passed_over(run_dir: Path, text: str) -> None:
    (run_dir / "r0.r1.cut").write_text(text)
    (run_dir / "r0.cut").write_text("5.0")
    assert cuts_in(run_dir) == {}
