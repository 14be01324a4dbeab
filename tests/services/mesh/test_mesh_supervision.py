"""How long a silent Bluetooth connection is kept: bytes, what the mesh does after a dial, and what stands in its way.
The effect is shown over a kernel's own Bluetooth: tests/lab/inside_faults.py."""

import errno
import functools
import logging
import os
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
from hci_controller import ADAPTERS, HANDLE, PEER, Controller
from hypothesis import given
from hypothesis import strategies as st

from services.mesh.links import supervision
from swarm.bluetooth import hci
from swarm.bluetooth.adapter import Adapter
from swarm.errors import LocalError

OWN = ADAPTERS[3]

DONE = bytes.fromhex("04 0e 06 01 37 0c 00 0b 00")
PERIPHERAL = bytes.fromhex("04 0e 06 01 37 0c 0c 0b 00")


def test_golden_bytes() -> None:
    """By the specification: opcode 0x0c37, handle 11, 2 s = 3200 slots of 0.625 ms."""
    assert hci.write_supervision(11, 2.0) == bytes.fromhex("01 37 0c 04 0b 00 80 0c")
    assert hci.written_supervision(DONE) == 0
    assert hci.written_supervision(PERIPHERAL) == 0x0C
    assert hci.written_supervision(bytes.fromhex("04 0f 04 01 01 37 0c")) == 1
    assert hci.written_supervision(bytes.fromhex("04 0e 07 01 05 14 00 0b 00 c4")) is None, "another command's end"


@given(st.binary(max_size=300))
def test_any_bytes_are_an_answer_or_none(packet: bytes) -> None:
    assert hci.written_supervision(packet) in (None, *range(256))


@pytest.mark.parametrize("seconds", [0.0, 0.0001, 41.0, -1.0])
def test_times_that_no_controller_takes_are_refused(seconds: float) -> None:
    with pytest.raises(LocalError, match="supervision time-out"):
        hci.write_supervision(1, seconds)


@pytest.fixture
def controller() -> Iterator[Controller]:
    with Controller() as made:
        yield made


@pytest.fixture
def adapter(controller: Controller, monkeypatch: pytest.MonkeyPatch) -> Controller:
    made = functools.partial(Adapter, open_socket=controller.open, ioctl=controller.ioctl)
    monkeypatch.setattr(supervision, "Adapter", made)
    monkeypatch.setattr(supervision, "_told", set())
    controller.answers = lambda _: [DONE]
    return controller


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def test_a_connection_is_over_before_the_mesh_takes_others_for_dead(
    adapter: Controller, caplog: pytest.LogCaptureFixture
) -> None:
    supervision.try_limit(OWN, PEER, 3.0)
    assert adapter.bound == 3
    assert adapter.asked == [struct.pack("<BHBHH", 1, 0x0C37, 4, HANDLE, 3200)]
    assert warnings(caplog) == []


def test_what_stands_in_its_way_is_said_once_and_breaks_nothing(
    adapter: Controller, caplog: pytest.LogCaptureFixture
) -> None:
    adapter.refuses = OSError(errno.EPERM, os.strerror(errno.EPERM))
    for _ in range(3):
        supervision.try_limit(OWN, PEER, 3.0)
    assert len(warnings(caplog)) == 1
    assert "CAP_NET_RAW" in warnings(caplog)[0]
    adapter.refuses = None
    adapter.answers = lambda _: [PERIPHERAL]
    supervision.try_limit(OWN, PEER, 3.0)
    assert "HCI status 0x0c" in warnings(caplog)[1]


def test_the_mesh_of_a_robot_may_do_it_and_no_other_service() -> None:
    """The units as they are shipped: the capability in the one drop-in, which systemd reads after the common file."""
    folder = Path(__file__).parents[3] / "deploy/systemd"
    files = {path for path in folder.rglob("*") if path.is_file() and "CAP_NET_RAW" in path.read_text()}
    assert files == {folder / "swarm-mesh.service.d/50-radio.conf"}
    assert sorted(path.name for path in folder.rglob("*.conf"))[0] == "10-common.conf"
