"""RFCOMM links over a stand-in socket family with the faults of the real one (docs/reference/network/frames.md,
sockets).

Neither this kernel nor CI's has Bluetooth; what a stand-in cannot show is range, pairing and the real stack.
"""

import socket
from collections.abc import Callable
from pathlib import Path

import pytest
from rfcomm_air import RfcommAir
from rfcomm_rig import CONFIG, STRANGER, A, B, C, accept, air, dial, listener, local, read, write

from services.mesh.core.link.calls import UNKNOWN, Caller
from services.mesh.links import rfcomm
from services.mesh.links.rfcomm import Radio
from services.mesh.network import Network
from swarm import clock
from swarm.config import parse
from swarm.errors import LocalError

__all__ = ["air", "listener"]


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


def test_who_was_called_can_limit_the_silence_too_which_makes_it_the_central(air: RfcommAir) -> None:
    limits: list[tuple[str, str, float]] = []
    listener = rfcomm.RfcommListener(
        Radio(B), {A: "r0"}, open_socket=air.open, supervise=lambda *each: limits.append(each)
    )
    pipes = dial(air), accept(listener)
    assert pipes[1].limit is not None
    pipes[1].limit(3.0)
    assert limits == [(B, A, 3.0)]
    for each in (*pipes, listener):
        each.close()


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
