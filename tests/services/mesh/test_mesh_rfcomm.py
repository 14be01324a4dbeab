"""RFCOMM links over a stand-in socket family with the faults of the real one (docs/reference/network/frames.md,
sockets).

Neither this kernel nor CI's has Bluetooth; what a stand-in cannot show is range, pairing and the real stack.
"""

import logging
import os
import random
import select
import socket
import types
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import cast

import pytest
from conftest import wait_until
from rfcomm_air import RfcommAir

from services.mesh.core import calling
from services.mesh.core.link import calls
from services.mesh.core.link.calls import UNKNOWN, Caller, Local, dials
from services.mesh.core.routing.topology import Ground
from services.mesh.core.routing.wanted_links import InitialLinks
from services.mesh.core.wire import frames
from services.mesh.core.wire.frames import Hello
from services.mesh.links import pybluez, rfcomm
from services.mesh.links.pipe import Pipe
from services.mesh.links.rfcomm import Radio
from services.mesh.mesh import Chance
from services.mesh.mesh import Mesh as Shell
from services.mesh.network import Network
from services.mesh.sockets import Sockets
from swarm import clock
from swarm.bus.protocol import BusLike
from swarm.config import parse
from swarm.errors import LocalError
from swarm.process.locked_runtime import LockedRuntime

A, B, C = (f"B8:27:EB:00:00:0{digit}" for digit in "ABC")
STRANGER = "00:11:22:33:44:55"


@pytest.fixture
def air() -> Iterator[RfcommAir]:
    made = RfcommAir(A, B)
    yield made
    for sock in made.sockets:
        sock.close()


@pytest.fixture
def listener(air: RfcommAir) -> Iterator[rfcomm.RfcommListener]:
    made = rfcomm.RfcommListener(Radio(B), {A.lower(): "r0"}, open_socket=air.open)
    yield made
    made.close()


def dial(air: RfcommAir, adapter: str = A, **radio: object) -> Pipe:
    return rfcomm.dial(Radio(adapter, **radio), B, open_socket=air.open)  # type: ignore[arg-type]


def accept(listener: rfcomm.RfcommListener) -> Pipe:
    wait_until(lambda: select.select([listener], [], [], 0)[0])
    return listener.accept()


def read(pipe: Pipe) -> bytes:
    """What the mesh's thread would get next, without waiting longer than a test may."""
    found: list[bytes] = []

    def look() -> bool:
        now = clock.now()
        if pipe.wants_read(now) and select.select([pipe], [], [], 0)[0]:
            pipe.read(now)
        if (data := pipe.take(now)) is not None:
            found.append(data)
        return bool(found)

    wait_until(look)
    return found[0]


def write(pipe: Pipe, data: bytes) -> None:
    pipe.offer(data)
    assert pipe.flush()


# -- each row of the table --


def test_bytes_pass_and_the_caller_is_known_by_its_address(air: RfcommAir, listener: rfcomm.RfcommListener) -> None:
    near, far = dial(air), accept(listener)
    assert (near.caller, far.caller) == (UNKNOWN, Caller(A, robot="r0"))
    write(near, b"ping")
    assert read(far) == b"ping"
    write(far, b"pong")
    assert read(near) == b"pong"


def test_an_unknown_address_stands_for_no_robot(air: RfcommAir, listener: rfcomm.RfcommListener) -> None:
    air.adapters.add(STRANGER)
    dial(air, STRANGER)
    assert accept(listener).caller == Caller(STRANGER, robot="")


def test_the_end_is_a_reset_after_the_last_bytes_and_nothing_is_read_after_it(
    air: RfcommAir, listener: rfcomm.RfcommListener
) -> None:
    near, far = dial(air), accept(listener)
    write(far, b"last words")
    far.close()
    assert read(near) == b"last words"
    assert read(near) == b""
    assert near.fault == "connection reset by peer"
    assert not near.wants_read(clock.now())
    assert near.next_change(clock.now()) is None
    assert near.take(clock.now()) is None


def test_a_reset_that_the_writer_meets_first_still_ends_the_connection(
    air: RfcommAir, listener: rfcomm.RfcommListener
) -> None:
    near, far = dial(air), accept(listener)
    assert not near.restless
    far.close()
    write(near, b"into the void")
    assert near.restless, "who waits for it is to look at once, since the socket may never be readable"
    assert near.fault == "connection reset by peer"
    assert near.next_change(5.0) == 5.0, "the reader is to look, though its read would wait for ever"
    assert read(near) == b""


def test_a_lost_radio_is_a_time_out(air: RfcommAir, listener: rfcomm.RfcommListener) -> None:
    near, far = dial(air), accept(listener)
    next(sock for sock in air.sockets if sock.fileno() == near.fileno()).silent = True
    write(far, b"wake")
    assert read(near) == b""
    assert near.fault == "connection timed out"


def test_a_full_socket_waits_without_an_error(air: RfcommAir, listener: rfcomm.RfcommListener) -> None:
    near, _ = dial(air), accept(listener)
    for _ in range(1000):
        near.offer(bytes(4000))
        if not near.flush():
            break
    else:
        pytest.fail("the socket never filled")
    assert not near.fault


@pytest.mark.parametrize(
    ("prepare", "message"),
    [
        (lambda air: air.out_of_range.add(B), "host is down: not in range"),
        (lambda air: air.listening.clear(), "connection refused: no mesh listens there on that channel, or "),
        (lambda air: air.pairs.add((A, B)), "device or resource busy: an earlier connection"),
        (lambda air: air.adapters.discard(A), "no route to host: the own Bluetooth adapter is not there"),
    ],
)
def test_why_a_dial_failed_is_said(
    air: RfcommAir, listener: rfcomm.RfcommListener, prepare: Callable[[RfcommAir], object], message: str
) -> None:
    prepare(air)
    with pytest.raises(OSError, match=message):
        dial(air)
    assert all(sock.fileno() < 0 for sock in air.sockets[1:]), "the socket of a failed dial is closed"


def test_pythons_own_time_out_has_a_text_too(air: RfcommAir, monkeypatch: pytest.MonkeyPatch) -> None:
    def hang(*_: object) -> None:
        raise TimeoutError("timed out")

    monkeypatch.setattr("rfcomm_air.RfcommSocket.connect", hang)
    with pytest.raises(OSError, match="no answer within 10 s"):
        dial(air)


def test_a_taken_channel_is_named(air: RfcommAir, listener: rfcomm.RfcommListener) -> None:
    with pytest.raises(LocalError, match=f"Bluetooth {B} channel 1: address already in use.*holds channel 8"):
        rfcomm.RfcommListener(Radio(B), {}, open_socket=air.open)
    rfcomm.RfcommListener(Radio(B, channel=2), {}, open_socket=air.open).close()


def test_an_unknown_adapter_is_named(air: RfcommAir) -> None:
    with pytest.raises(LocalError, match=f"Bluetooth {C} channel 1: no route to host: the own Bluetooth adapter"):
        rfcomm.RfcommListener(Radio(C), {}, open_socket=air.open)


def test_encryption_is_asked_for_before_connecting_and_listening(air: RfcommAir) -> None:
    rfcomm.RfcommListener(Radio(B, encrypt=True), {}, open_socket=air.open)
    dial(air, encrypt=True)
    assert [sock.security for sock in air.sockets] == [b"\x02\x00", b"\x02\x00"]


# -- this interpreter, this kernel --


def test_an_interpreter_without_bluetooth_says_which_one_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(socket, "AF_BLUETOOTH", raising=False)
    with pytest.raises(LocalError, match=r"built without Bluetooth sockets.*python3 -m venv --system-site-packages"):
        rfcomm.open_socket()


@pytest.mark.skipif(hasattr(socket, "AF_BLUETOOTH"), reason="this Python has Bluetooth")
def test_a_mesh_that_needs_bluetooth_says_at_once_that_there_is_none(runtime: Path) -> None:
    with pytest.raises(LocalError, match="built without Bluetooth sockets"):
        Network(parse(CONFIG, Path("swarm.toml")), local("r0"), runtime)


def test_a_kernel_without_bluetooth_is_named(runtime: Path) -> None:
    def nothing() -> socket.socket:
        raise OSError(97, "Address family not supported by protocol")

    with pytest.raises(LocalError, match=r"rfcomm: links need Bluetooth: .*this kernel has no Bluetooth"):
        Network(parse(CONFIG, Path("swarm.toml")), local("r0"), runtime, open_bluetooth=nothing)


def test_a_robot_alone_in_its_file_needs_no_bluetooth(runtime: Path) -> None:
    def nothing() -> socket.socket:
        raise OSError(97, "Address family not supported by protocol")

    network = Network(parse(ALONE, Path("swarm.toml")), local("r0", ALONE, pages=True), runtime, open_bluetooth=nothing)
    assert network.listeners == []
    network.close()


# -- meshes over it --

ALONE = f"""\
network = "lab"
[[robots]]
name = "r0"
bluetooth = "{A}"
[topology]
edges = []
[mesh]
insecure = true
"""

CONFIG = f"""\
network = "lab"
[[robots]]
name = "r0"
bluetooth = "{A}"
[[robots]]
name = "r1"
bluetooth = "{B}"
[topology]
shape = "line"
[mesh]
insecure = true
"""


THREE = CONFIG.replace("[topology]", f'[[robots]]\nname = "r2"\nbluetooth = "{C}"\n[topology]')


def local(me: str, text: str = CONFIG, *, pages: bool = False) -> Local:
    config = parse(text, Path("swarm.toml"))
    return Local(
        me,
        "lab",
        random.getrandbits(64),
        insecure=True,
        dials={peer: dials(config.robot(me), config.robot(peer)) for peer in config.neighbours(me)},
        robots=frozenset(config.names),
        pages=pages,
    )


class Mesh:
    """A whole mesh of one robot over the stand-in."""

    def __init__(self, name: str, air: RfcommAir, directory: Path, text: str = CONFIG, *, pages: bool = False) -> None:
        config, own = parse(text, Path("swarm.toml")), local(name, text, pages=pages)
        self.limits: list[tuple[str, str, float]] = []
        """Own and other address, time-out of the mesh: whose silence was to be limited."""
        self.network = Network(
            config, own, directory, open_bluetooth=air.open, supervise=lambda *each: self.limits.append(each)
        )
        self.counters: Counter[str] = Counter()
        self.inbox: list[tuple[str, bytes]] = []
        runtime = LockedRuntime(cast(BusLike, self), self.counters, logging.getLogger("mesh"))
        self.sockets = Sockets(runtime, self.network.listeners, self.network.dial)
        self.mesh = Shell(
            config,
            own,
            InitialLinks(Ground(config.names, config.edges, auto=False), own.dials),
            Chance(random.random, lambda: os.urandom(16)),
            own.incarnation,
            runtime,
            self.sockets,
            keep=lambda data: None,
        )
        self.links = runtime.entry(self.mesh.links)
        self.relay = runtime.entry(self.mesh.publish)
        self.sockets.start(self.mesh)

    def wanted(self, key: str) -> bool:
        return False

    def publish(self, key: str, payload: bytes, *, urgent: bool) -> None:
        self.inbox.append((key, payload))

    @property
    def state(self) -> tuple[str, int, str]:
        (link,) = self.links().links
        return link.state, link.connection, link.reason

    def stop(self) -> None:
        self.sockets.stop()
        self.network.close()


def test_meshes_meet_over_rfcomm_part_and_meet_again(air: RfcommAir, runtime: Path) -> None:
    air.page_timeout = 0.05
    air.out_of_range.add(B)
    near, far = Mesh("r0", air, runtime), Mesh("r1", air, runtime)
    wait_until(lambda: near.state[2].startswith("host is down"))
    air.out_of_range.clear()
    wait_until(lambda: near.state[0] == far.state[0] == "up")
    key = "swarm/r0/app/x/sync/a"
    near.relay(0, key, b"hello")
    wait_until(lambda: (key, b"hello") in far.inbox)
    # The far robot loses its sockets as kill -9 would have it.
    for sock in [sock for sock in air.sockets if sock.fileno() >= 0 and sock.adapter == ""]:
        sock.shutdown(socket.SHUT_RDWR)
    wait_until(lambda: near.state[:2] == far.state[:2] == ("up", 2))
    assert near.counters["transport_lost"] == 1
    # For each link, by who has dialled.
    wait_until(lambda: near.limits == [(A, B, 3.0)] * 2)
    assert far.limits == []
    near.stop()
    far.stop()


def test_a_robot_that_is_back_knocks_at_one_that_only_calls(
    air: RfcommAir, runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the knock r0 would call again in hours."""
    monkeypatch.setattr(calls, "SHARE", 1e-7)
    monkeypatch.setattr(calling, "KNOCK", 0.05)
    air.page_timeout = 0.05
    air.out_of_range.add(B)
    near = Mesh("r0", air, runtime, pages=True)
    wait_until(lambda: air.in_vain.count(B) == calls.EAGER)
    air.out_of_range.clear()
    far = Mesh("r1", air, runtime, pages=True)
    wait_until(lambda: near.state[0] == far.state[0] == "up")
    wait_until(lambda: len(near.limits) == 1)
    assert far.limits == []  # r0 has called: the roles are those wanted
    asks = {sock.adapter: sock.link_mode for sock in air.sockets if sock.fileno() >= 0 and sock.channel}
    assert asks == {A: rfcomm.RFCOMM_LM_MASTER, B: 0}  # a knock at r0, which calls all, makes r0 the central
    near.stop()
    far.stop()


class L2capSocket:
    """A raw socket that notes what is done with it."""

    def __init__(self, done: list[object]) -> None:
        self._done = done

    def setblocking(self, blocking: bool) -> None:
        assert not blocking

    def bind(self, address: object) -> None:
        self._done.append(address)

    connect = send = bind

    def close(self) -> None:
        self._done.append("closed")


def test_a_nudge_is_an_echo_request_from_the_own_adapter_to_the_other_end(
    air: RfcommAir, listener: rfcomm.RfcommListener, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[object] = []
    near, far = dial(air), accept(listener)
    monkeypatch.setattr(rfcomm, "open_l2cap_socket", lambda: L2capSocket(done))
    near.nudge()
    far.nudge()
    echo = bytes.fromhex("08c80000")
    assert done == [(A, 0), (B, 0), echo, "closed", (B, 0), (A, 0), echo, "closed"]


def test_a_nudge_without_the_right_to_a_raw_socket_does_no_harm(
    air: RfcommAir, listener: rfcomm.RfcommListener, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused() -> None:
        raise PermissionError

    monkeypatch.setattr(rfcomm, "open_l2cap_socket", refused)
    dial(air).nudge()


def test_the_other_links_are_nudged_when_one_has_ended(
    air: RfcommAir, runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nudged: list[str] = []
    monkeypatch.setattr(rfcomm.RfcommPipe, "nudge", lambda pipe: nudged.append(pipe._peer))
    air.adapters.add(C)
    meshes = {name: Mesh(name, air, runtime, THREE) for name in ("r0", "r1", "r2")}  # a line
    middle = meshes["r1"]
    wait_until(lambda: [each.state for each in middle.links().links] == ["up", "up"])
    assert nudged == []
    for sock in [sock for sock in air.sockets if sock.fileno() >= 0 and sock.adapter == A and not sock.channel]:
        sock.shutdown(socket.SHUT_RDWR)
    wait_until(lambda: nudged == [C])
    for mesh in meshes.values():
        mesh.stop()


def test_a_call_from_the_address_of_no_robot_is_ended_before_a_handshake(air: RfcommAir, runtime: Path) -> None:
    far = Mesh("r1", air, runtime)
    air.adapters.add(STRANGER)
    pipe = dial(air, STRANGER)
    write(pipe, frames.encode_hello(Hello("lab", "r0", 1, bytes(16), dialler=True, insecure=True)))
    assert not read(pipe)
    assert far.counters["refused_robot"] == 1
    far.stop()


# -- PyBluez --


def test_without_pybluez_it_is_said_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "bluetooth", None)
    with pytest.raises(LocalError, match="PyBluez is not installed: apt install python3-bluez"):
        pybluez.discover(1.0, ask_services=False)


class PyBluezSocket(socket.socket):
    """Knows of itself whether its own `listen` was called, whatever the kernel's socket behind it does (btmodule.c)."""

    listens = False

    def bind(self, address: tuple[str, int]) -> None:
        assert address == ("", 0)

    def listen(self, backlog: int) -> None:
        self.listens = True


@pytest.fixture
def bluetooth(monkeypatch: pytest.MonkeyPatch) -> types.SimpleNamespace:
    """A module with the calls of PyBluez 0.23 that are used."""
    module = types.SimpleNamespace(
        RFCOMM=3,
        SERIAL_PORT_CLASS="1101",
        SERIAL_PORT_PROFILE=("1101", 0x0100),
        advertised=[],
        BluetoothSocket=lambda protocol: PyBluezSocket(socket.AF_UNIX),
        discover_devices=lambda duration, flush_cache, lookup_names: [(B.lower(), "raspberrypi"), (A, "phone")],
        find_service=lambda uuid, address: (
            [{"protocol": "L2CAP", "port": 3}, {"protocol": "RFCOMM", "port": 1}] if address == B.lower() else []
        ),
    )

    def advertise_service(sock: PyBluezSocket, *names: str, **ids: object) -> None:
        if not sock.listens:
            raise OSError("must have already called socket.listen()")
        module.advertised.append((sock.getsockname(), names, ids))

    module.advertise_service = advertise_service
    monkeypatch.setitem(__import__("sys").modules, "bluetooth", module)
    return module


def test_devices_in_range_and_their_meshes_are_found(bluetooth: types.SimpleNamespace) -> None:
    phone, robot = pybluez.discover(5.0, ask_services=True)
    assert (phone.address, phone.channel) == (A, None)
    assert (robot.address, robot.name, robot.channel) == (B, "raspberrypi", 1)


def test_the_adapter_that_looks_can_be_chosen(
    bluetooth: types.SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    inner = types.SimpleNamespace(hci_devid=lambda name: 1 if name in ("hci1", A) else -1)
    monkeypatch.setitem(__import__("sys").modules, "bluetooth._bluetooth", inner)
    asked: list[int] = []

    def discover_devices(device_id: int = -1, **_: object) -> list[tuple[str, str]]:
        asked.append(device_id)
        return []

    bluetooth.discover_devices = discover_devices
    for name in ("", "hci1", A):
        assert pybluez.discover(1.28, ask_services=False, adapter=name) == []
    assert asked == [-1, 1, 1]
    with pytest.raises(LocalError, match="there is no Bluetooth adapter hci7"):
        pybluez.discover(1.28, ask_services=False, adapter="hci7")


def test_the_record_is_that_of_the_listening_socket(
    bluetooth: types.SimpleNamespace, air: RfcommAir, listener: rfcomm.RfcommListener
) -> None:
    record = pybluez.Record(listener.fileno())
    ((address, names, ids),) = bluetooth.advertised
    assert address.decode() == air.listening[B, 1]
    assert names == (pybluez.SERVICE_NAME,)
    assert ids["service_id"] == pybluez.SERVICE
    record.close()
