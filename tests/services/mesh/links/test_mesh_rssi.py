"""`swarm measure rssi`: the bytes of the HCI, a stand-in for the kernel's raw HCI sockets, and what is said where a
link has no radio. What this cannot show is a real controller's answer."""

import argparse
import errno
import functools
import json
import os
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from hci_controller import ADAPTERS, HANDLE, PEER, Controller, complete
from hypothesis import given
from hypothesis import strategies as st

from laptop.cli.measure import rssi as command
from swarm.bluetooth import adapter as adapters
from swarm.bluetooth import hci
from swarm.bluetooth.adapter import Adapter
from swarm.errors import FrameError, LocalError
from swarm.onboard.measure import rssi
from swarm.onboard.measure.rssi import strength
from swarm.onboard.mesh import radio as mesh_radio

# -- bytes ---------------------------------------------------------------------------------------------------


def test_reading_the_rssi_has_these_bytes() -> None:
    """By the specification: opcode 0x1405, handle 11; -60 dB for it."""
    assert hci.read(hci.READ_RSSI, 11) == bytes.fromhex("01 05 14 02 0b 00")
    assert hci.reading(bytes.fromhex("04 0e 07 01 05 14 00 0b 00 c4")) == hci.Reading(0, 11, -60)
    assert hci.reading(bytes.fromhex("04 0e 04 01 05 14 02")) == hci.Reading(2, 0, 0)
    assert hci.reading(bytes.fromhex("04 0f 04 0c 01 05 14")) == hci.Reading(12, 0, 0)
    assert hci.reading(bytes.fromhex("04 0e 07 01 03 14 00 0b 00 ff"), hci.READ_QUALITY) == hci.Reading(0, 11, 255)
    failed = bytes.fromhex("04 0e 08 01 01 14 00 0b 00 02 01")
    assert hci.reading(failed, hci.READ_FAILED_CONTACTS) == hci.Reading(0, 11, 258)
    assert hci.reading(failed) is None, "another reading"
    assert hci.reading(bytes.fromhex("04 0e 04 01 03 0c 00")) is None, "another command's end"
    assert hci.reading(bytes.fromhex("04 05 04 00 0b 00 13")) is None, "another event"
    assert bytes(16) < hci.FILTER == bytes.fromhex("10000000 00c00400 00000000 0000 0000")
    assert hci.packed_address("B8:27:EB:12:34:56") == bytes.fromhex("563412eb27b8")
    assert (len(hci.connection_info(bytes(6))), len(hci.device_info(0)), len(hci.device_list())) == (24, 92, 132)


@pytest.mark.parametrize("text", ["", "B8:27:EB:12:34", "B8:27:EB:12:34:56:78", "so what"])
def test_what_is_no_address_is_said(text: str) -> None:
    with pytest.raises(LocalError, match="expected six bytes"):
        hci.packed_address(text)


@given(st.binary(max_size=300))
def test_any_bytes_are_an_answer_or_none_or_refused(packet: bytes) -> None:
    with suppress(FrameError):
        hci.reading(packet)


@given(st.integers(0, 255), st.integers(0, 0xEFF), st.integers(-128, 127))
def test_every_reading_comes_through(status: int, handle: int, value: int) -> None:
    packet = struct.pack("<BBBBHBHb", hci.EVENT, hci.COMPLETE, 7, 1, hci.READ_RSSI, status, handle, value)
    assert hci.reading(packet) == hci.Reading(status, handle, value)


@pytest.fixture
def controller() -> Iterator[Controller]:
    with Controller() as made:
        yield made


def adapter_of(controller: Controller, address: str = ADAPTERS[3]) -> Adapter:
    return Adapter(address, open_socket=controller.open, ioctl=controller.ioctl)


def test_the_adapter_of_the_address_is_asked(controller: Controller) -> None:
    controller.values = [-60, -61, 5]
    adapter = adapter_of(controller)
    assert (controller.bound, controller.filtered) == (3, hci.FILTER)
    assert [strength(adapter, PEER) for _ in range(3)] == [-60, -61, 5]


def test_what_others_ask_the_adapter_is_not_taken_for_the_answer(controller: Controller) -> None:
    noise = [complete(HANDLE + 1, -1), bytes.fromhex("04 0e 04 01 03 0c 00"), b"\x02", b"\x04\x0e\x00"]
    controller.answers = lambda handle: [*noise, complete(handle, -47)]
    assert strength(adapter_of(controller), PEER) == -47


@pytest.mark.parametrize(
    ("answers", "text"),
    [
        (lambda handle: [complete(handle, 0, hci.NO_CONNECTION)], "no connection to B8:27:EB:00:00:0B any more"),
        (lambda handle: [bytes.fromhex("04 0f 04 0c 01 05 14")], "HCI status 0x0c"),
        (lambda handle: [bytes.fromhex("04 0f 04 01 01 05 14")], "does not tell the signal strength"),
        (lambda handle: [], r"does not answer \(0\.05 s\)"),
    ],
)
def test_no_reading_is_said(
    controller: Controller, answers: Callable[[int], list[bytes]], text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adapters, "TIMEOUT", 0.05)
    controller.answers = answers
    with pytest.raises(LocalError, match=text):
        strength(adapter_of(controller), PEER)


def test_no_connection_and_no_adapter_are_said(controller: Controller) -> None:
    with pytest.raises(LocalError, match="no Bluetooth adapter here has the address 00:00:00:00:00:01"):
        adapter_of(controller, "00:00:00:00:00:01")
    adapter = adapter_of(controller)
    controller.connected.clear()
    with pytest.raises(LocalError, match="there is no Bluetooth connection to B8:27:EB:00:00:0B"):
        strength(adapter, PEER)


# -- the command -----------------------------------------------------------------------------------------------

CONFIG = """\
network = "test"
[[robots]]
name = "r0"
bluetooth = "B8:27:EB:00:00:0A"
[[robots]]
name = "r1"
bluetooth = "B8:27:EB:00:00:0B"
[[robots]]
name = "r2"
link = "tcp:127.0.0.1:4100"
[topology]
edges = [["r0", "r1"], ["r0", "r2"]]
[mesh]
insecure = true
"""


@pytest.fixture
def args(runtime: Path, monkeypatch: pytest.MonkeyPatch) -> argparse.Namespace:
    (runtime / "swarm.toml").write_text(CONFIG)
    monkeypatch.setenv("SWARM_CONFIG", str(runtime / "swarm.toml"))
    monkeypatch.setattr(rssi.links, "ends", lambda args: ("r0", args.peer, runtime / "r0"))
    return argparse.Namespace(count=3, json=True, plot=None, peer="r1")


def test_readings_of_the_signal_strength_are_printed(
    args: argparse.Namespace,
    controller: Controller,
    runtime: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pauses: list[float] = []
    monkeypatch.setattr(rssi.time, "sleep", pauses.append)
    own = functools.partial(Adapter, open_socket=controller.open, ioctl=controller.ioctl)
    monkeypatch.setattr(rssi, "Adapter", own)
    controller.values = [-60, -58, -62]
    assert command.run(args) == 0
    assert json.loads(capsys.readouterr().out)["rssi"] == [-60, -58, -62]
    assert pauses == [rssi.PERIOD] * 2
    args.json, args.plot = False, runtime / "rssi.png"
    monkeypatch.setenv("MPLCONFIGDIR", str(runtime))
    assert command.run(args) == 0
    assert "min -62, median -62, mean -62.0, max -62" in capsys.readouterr().out
    assert args.plot.stat().st_size > 1000


def test_connections_are_told_and_what_the_adapter_does_not_know_is_unknown(
    args: argparse.Namespace, controller: Controller, runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = functools.partial(Adapter, open_socket=controller.open, ioctl=controller.ioctl)
    monkeypatch.setattr(mesh_radio, "Adapter", own)
    quality = bytes.fromhex("04 0e 07 01 03 14 00 0b 00 fe")
    controller.answers = lambda _: [complete(HANDLE, -61), quality, bytes.fromhex("04 0e 04 01 01 14 01")]
    (reading,) = mesh_radio.read({"r0": runtime / "r0"})
    assert reading == mesh_radio.RadioReading("r0", "r1", "central", -61, 254, None)
    text = mesh_radio.table([reading])
    assert text[1].split() == ["r0", "r1", "central", "-61", "254", "unknown"]
    assert text[2].startswith("retransmissions: unknown")
    controller.state = 5  # only called
    assert mesh_radio.read({"r0": runtime / "r0"}) == []
    with pytest.raises(LocalError, match="this link has no radio"):
        mesh_radio.read({"r2": runtime / "r2"})


def test_a_link_without_a_radio_is_said(args: argparse.Namespace, runtime: Path) -> None:
    with pytest.raises(LocalError, match=r"r0 - r2: this link has no radio: r2 is reached by tcp:127\.0\.0\.1:4100"):
        command.run(argparse.Namespace(**{**vars(args), "peer": "r2"}))
    with pytest.raises(LocalError, match="there is no robot r7, there are r0 r1 r2"):
        command.run(argparse.Namespace(**{**vars(args), "peer": "r7"}))


def test_a_kernel_without_bluetooth_is_said(
    args: argparse.Namespace, runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EAFNOSUPPORT, os.strerror(errno.EAFNOSUPPORT))

    monkeypatch.setattr(rssi, "Adapter", refuse)
    with pytest.raises(LocalError, match="this kernel has no Bluetooth"):
        command.run(args)
