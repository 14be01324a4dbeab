"""Transports by themselves: simulated air with cuts, back-pressure, ends of connections, left-over sockets."""

import os
import select
import socket
import struct
import threading
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest
from conftest import wait_until

from bench.rigs.ports import free_port
from services.mesh import link_address
from services.mesh.link_address import Rfcomm, Sim, Slots, Tcp
from services.mesh.links import sim, tcp
from services.mesh.links.pipe import Pipe
from swarm import clock
from swarm.config.types import RobotConfig
from swarm.errors import ConfigError, LocalError, SwarmError


class Place:
    """Two robots' ends of the simulated air, and the listener of the second."""

    def __init__(self, runtime: Path) -> None:
        for name in ("r0", "r1"):
            (runtime / name).mkdir()
        self.runtime = runtime
        self.path = runtime / "r1/mesh.sock"
        self.near = sim.LinkConditions("r0", runtime / "r0")
        self.far = sim.LinkConditions("r1", runtime / "r1")
        self.listener = sim.SimListener(self.path, self.far)
        self.pipes: list[Pipe] = []

    def connect(self) -> tuple[Pipe, Pipe]:
        self.pipes += (sim.dial(self.path, self.near, "r1"), self.listener.accept())
        return self.pipes[-2], self.pipes[-1]

    def send_cut(self, robot: str, peer: str, seconds: float) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
            sock.sendto(
                msgpack.packb({"cut": peer, "seconds": seconds}), os.fspath(self.runtime / robot / sim.AIR_SOCKET)
            )

    def cut(self, robot: str, peer: str, seconds: float) -> None:
        air, asked = self.near if robot == "r0" else self.far, clock.now()
        self.send_cut(robot, peer, seconds)
        wait_until(lambda: air.cut_until(peer) >= asked + seconds)

    def close(self) -> None:
        for pipe in self.pipes:
            pipe.close()
        self.listener.close()
        self.near.close()
        self.far.close()


@pytest.fixture
def model() -> str:
    return ""


@pytest.fixture
def place(runtime: Path, model: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    monkeypatch.setenv(sim.LINK_VARIABLE, model)
    built = Place(runtime)
    yield built
    built.close()


def receive(pipe: Pipe) -> bytes:
    """The next bytes of a connection, waited for as the mesh's thread does."""
    while True:
        now = clock.now()
        if (data := pipe.take(now)) is not None:
            return data
        change = pipe.next_change(now)
        readers = [pipe] if pipe.wants_read(now) else []
        if select.select(readers, [], [], None if change is None else max(0.0, change - now))[0]:
            pipe.read(clock.now())


def write(pipe: Pipe, data: bytes) -> None:
    pipe.offer(data)
    assert pipe.flush()


def test_bytes_pass_a_link_in_both_directions(place: Place) -> None:
    near, far = place.connect()
    write(near, b"ping")
    assert receive(far) == b"ping"
    write(far, b"pong")
    assert receive(near) == b"pong"


@pytest.mark.parametrize("model", ["latency=0.05"])
def test_latency_counts_from_the_write_and_the_end_travels_like_bytes(place: Place) -> None:
    near, far = place.connect()
    start = clock.now()
    write(near, b"a")
    write(near, b"b")
    near.shutdown()
    assert [receive(far), receive(far), receive(far)] == [b"a", b"b", b""]
    assert clock.now() - start >= 0.05


@pytest.mark.parametrize("model", ["latency=0.001,bandwidth=50000"])
def test_a_slow_air_fills_the_senders_socket(place: Place) -> None:
    near, far = place.connect()
    offered, start = 0, clock.now()
    while near.flush():
        near.offer(bytes(1000))
        offered += 1000
        assert offered < 200_000
    received = 0
    while received < 20_000:
        received += len(receive(far))
    assert clock.now() - start >= 0.8 * 20_000 / 50_000
    while received < offered:
        received += len(receive(far))
        near.flush()
    assert received == offered


@pytest.mark.parametrize("model", ["latency=0.01"])
def test_a_cut_holds_what_is_under_way_and_stops_dialling(place: Place) -> None:
    near, far = place.connect()
    write(near, b"before")
    assert receive(far) == b"before"
    write(near, b"under way")
    place.cut("r1", "r0", 0.3)
    end = place.far.cut_until("r0")
    assert receive(far) == b"under way"
    assert clock.now() >= end
    place.cut("r0", "r1", 60.0)
    with pytest.raises(ConnectionError, match="unreachable"):
        sim.dial(place.path, place.near, "r1")


def test_a_link_is_cut_while_one_of_two_cuts_holds_and_mended_by_0(place: Place) -> None:
    place.cut("r1", "r0", 60.0)
    end = place.far.cut_until("r0")
    place.cut("r1", "r0", 1.0)
    place.cut("r1", "r7", 1.0)  # the datagrams before it are taken
    assert place.far.cut_until("r0") == end
    place.send_cut("r1", "r0", 0.0)
    wait_until(lambda: not place.far.is_cut("r0"))


def test_a_mesh_that_is_started_anew_goes_on_with_a_cut_that_holds(place: Place) -> None:
    end = clock.now() + 60.0
    sim.cut_file(place.runtime, "r1", "r0").write_text(f"{end!r}\n")
    place.near.close()
    place.near = sim.LinkConditions("r0", place.runtime / "r0")
    assert place.near.cut_until("r1") == end
    assert not place.near.is_cut("r2")


def test_who_is_cut_off_is_not_let_in(place: Place) -> None:
    place.cut("r1", "r0", 60.0)
    _, far = place.connect()
    assert receive(far) == b""
    assert far.fault == "unreachable"


@pytest.mark.parametrize("datagram", [b"", b"\xc1", msgpack.packb({"cut": "r0"}), msgpack.packb([1]), bytes(3000)])
def test_wrong_cuts_are_ignored(place: Place, datagram: bytes) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.sendto(datagram, os.fspath(place.runtime / "r1" / sim.AIR_SOCKET))
    place.cut("r1", "r0", 60.0)


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"\x00", "without a name"),
        (b"\xff" + bytes(200), "without a name"),
        (b"\x02r0" + struct.pack("<Id", 0, 0.0), "write of 0 bytes"),
        (b"\x02r0" + struct.pack("<Id", 1 << 30, 0.0), "write of 1073741824 bytes"),
    ],
)
def test_a_caller_that_is_no_mesh_is_an_error_of_the_transport(place: Place, data: bytes, text: str) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.connect(os.fspath(place.path))
        sock.sendall(data)
        pipe = place.listener.accept()
        assert receive(pipe) == b""
        assert text in pipe.fault
        pipe.close()


def test_records_split_anywhere_are_put_together(place: Place) -> None:
    record = struct.pack("<Id", 5, clock.now()) + b"hello"
    stream = b"\x02r0" + record * 3
    for cut in range(4, len(stream)):
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
            sock.connect(os.fspath(place.path))
            pipe = place.listener.accept()
            sock.sendall(stream[:cut])
            sock.sendall(stream[cut:])
            assert [receive(pipe) for _ in range(3)] == [b"hello"] * 3
            pipe.close()


def test_a_robot_has_one_mesh(place: Place) -> None:
    with pytest.raises(LocalError, match="another mesh of this robot runs already"):
        sim.LinkConditions("r0", place.runtime / "r0")
    near, far = place.connect()
    write(near, b"unharmed")
    assert receive(far) == b"unharmed"


def test_sockets_left_by_a_killed_run_are_replaced(runtime: Path) -> None:
    for name in (sim.AIR_SOCKET, "mesh.sock"):
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as left:
            left.bind(os.fspath(runtime / name))
    air = sim.LinkConditions("r1", runtime)
    listener = sim.SimListener(runtime / "mesh.sock", air)
    sim.dial(runtime / "mesh.sock", air, "r1").close()
    listener.close()
    air.close()
    assert sorted(path.name for path in runtime.iterdir()) == [sim.LOCK]


def test_a_missing_directory_is_named(runtime: Path) -> None:
    with pytest.raises(LocalError, match=r"nowhere/mesh\.lock: no such file"):
        sim.LinkConditions("r0", runtime / "nowhere")


# -- tcp -----------------------------------------------------------------------------------------------------


def test_tcp_passes_bytes_and_ends() -> None:
    address = Tcp("127.0.0.1", free_port())
    with pytest.raises(ConnectionRefusedError):
        tcp.dial(address)
    listener = tcp.TcpListener(address)
    near, far = tcp.dial(address), listener.accept()
    write(near, b"ping")
    assert receive(far) == b"ping"
    near.shutdown()
    near.shutdown()
    assert receive(far) == b""
    assert receive(near) == b"", "the own reader is woken too"
    for pipe in (near, far):
        pipe.close()
    listener.close()


def test_a_fault_while_writing_wakes_the_reader_and_is_named() -> None:
    address = Tcp("127.0.0.1", free_port())
    listener = tcp.TcpListener(address)
    near, far = tcp.dial(address), listener.accept()
    far._sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    far.close()  # with a reset
    wait_until(lambda: not write_more(near))
    assert near.fault in ("connection reset by peer", "broken pipe")
    near.close()
    listener.close()


def write_more(pipe: Pipe) -> bool:
    """Write until it fails; False then."""
    pipe.offer(b"x")
    pipe.flush()
    return not pipe.fault


def test_a_port_in_use_is_named() -> None:
    address = Tcp("127.0.0.1", free_port())
    listener = tcp.TcpListener(address)
    with pytest.raises(LocalError, match=rf"\[mesh\] listen: 127.0.0.1:{address.port}: address already in use"):
        tcp.TcpListener(address)
    listener.close()


def test_a_mesh_listens_at_an_address_that_the_robot_does_not_have_yet(caplog: pytest.LogCaptureFixture) -> None:
    """As on a boot, before the Wi-Fi is there: the mesh ended as for a wrong configuration, and was not started again.
    The address is one for documentation (RFC 5737)."""
    listener = tcp.TcpListener(Tcp("192.0.2.7", free_port()))
    listener.close()
    assert "nobody can call yet, this robot has no address 192.0.2.7" in caplog.text


# -- link addresses ------------------------------------------------------------------------------------------


def test_link_addresses_are_read() -> None:
    assert link_address.parse("sim:/tmp/r0/mesh.sock") == Sim(Path("/tmp/r0/mesh.sock"))
    assert link_address.parse("slots:/tmp/r0/mesh.sock") == Slots(Path("/tmp/r0/mesh.sock"))
    assert link_address.parse("tcp:robot.local:7447") == Tcp("robot.local", 7447)
    assert link_address.parse("rfcomm:b8:27:eb:00:00:01") == Rfcomm("B8:27:EB:00:00:01")
    assert link_address.parse("tcp:[::1]:7447") == Tcp("::1", 7447)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rfcomm:B8:27:EB:00:00", "or rfcomm:ADDRESS"),
        ("udp:host:1", "expected sim:PATH, tcp:HOST:PORT or rfcomm:ADDRESS"),
        ("sim:", "expected sim:PATH"),
        ("sim:/" + "x" * 120, "at most 107"),
        ("tcp:host", "expected HOST:PORT"),
        ("tcp:robot..local:5000", "'robot..local' is no name of a host"),
        ("tcp:host:0", "port from 1 to 65535"),
        ("tcp::7447", "expected HOST:PORT"),
        ("tcp:host:port", "expected HOST:PORT"),
    ],
)
def test_a_wrong_link_address_is_refused_with_what_was_expected(text: str, message: str) -> None:
    with pytest.raises(SwarmError, match=message):
        link_address.parse(text)


def test_a_robot_without_a_link_is_reached_by_bluetooth() -> None:
    assert link_address.of_robot(RobotConfig("r0", bluetooth="B8:27:EB:00:00:01")) == Rfcomm("B8:27:EB:00:00:01")
    with pytest.raises(ConfigError, match="robot r0: it has neither"):
        link_address.of_robot(RobotConfig("r0"))


@pytest.mark.parametrize("model", ["dial=60"])
def test_a_dial_takes_its_time_and_ends_with_the_mesh(place: Place) -> None:
    outcome: list[str] = []

    def dial() -> None:
        try:
            place.connect()
        except OSError as error:
            outcome.append(str(error))

    thread = threading.Thread(target=dial)
    thread.start()
    thread.join(0.1)
    assert thread.is_alive()
    place.near.close()
    thread.join()
    assert outcome == [sim.UNREACHABLE]
