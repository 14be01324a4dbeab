"""How long a silent Bluetooth connection is kept: bytes, what the mesh does after a dial, and what stands in its way.
The effect is shown over a kernel's own Bluetooth: tests/lab/inside/inside_faults.py."""

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

from services.mesh.links import role, supervision
from swarm.bluetooth import adapter as adapters
from swarm.bluetooth import hci
from swarm.bluetooth.adapter import Adapter
from swarm.errors import LocalError

OWN = ADAPTERS[3]

DONE = bytes.fromhex("04 0e 06 01 37 0c 00 0b 00")
PERIPHERAL = bytes.fromhex("04 0e 06 01 37 0c 0c 0b 00")


def test_writing_the_supervision_has_these_bytes() -> None:
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


def test_who_called_takes_the_role_of_the_central(adapter: Controller, caplog: pytest.LogCaptureFixture) -> None:
    """A connection that the other robot's knock has made has the other one as its central."""
    adapter.central = False
    supervision.try_limit(OWN, PEER, 3.0)
    address = hci.packed_address(PEER)
    assert adapter.asked == [hci.switch_role(address, hci.CENTRAL), hci.write_supervision(HANDLE, 2.0)]
    assert adapter.central
    assert warnings(caplog) == []


def test_a_switch_of_roles_that_is_refused_is_said(adapter: Controller, caplog: pytest.LogCaptureFixture) -> None:
    adapter.central, adapter.switches = False, 0x21
    supervision.try_limit(OWN, PEER, 3.0)
    assert "HCI status 0x21" in warnings(caplog)[0]
    assert len(adapter.asked) == 1


def test_a_switch_of_roles_has_a_patience_of_its_own(
    adapter: Controller, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It waits for the other adapter, which a page may keep away for longer than an own adapter needs to answer."""
    monkeypatch.setattr(adapters, "TIMEOUT", 0.0)
    adapter.central = False
    supervision.try_limit(OWN, PEER, 3.0)
    assert adapter.central
    assert "(0 s)" in warnings(caplog)[0]
    monkeypatch.setattr(adapters, "SWITCH_TIMEOUT", 0.0)
    monkeypatch.setattr(supervision, "_told", set())
    adapter.central, adapter.switches = False, None
    supervision.try_limit(OWN, PEER, 3.0)
    assert len(warnings(caplog)) == 2
    assert not adapter.central


def test_golden_bytes_of_a_switch_of_roles() -> None:
    """By the specification: opcode 0x080b, address, role 0 = central; Command Status, then Role Change."""
    address = hci.packed_address(PEER)
    assert hci.switch_role(address, hci.CENTRAL) == bytes.fromhex("01 0b 08 07 0b0000eb27b8 00")
    changed = bytes.fromhex("04 12 08 00 0b0000eb27b8 00")
    assert hci.switched_role(changed, address) == 0
    assert hci.switched_role(changed, bytes(6)) is None, "of another connection"
    assert hci.switched_role(bytes.fromhex("04 0f 04 00 01 0b 08"), address) is None, "its end is to come"
    assert hci.switched_role(bytes.fromhex("04 0f 04 0c 01 0b 08"), address) == 0x0C


@given(st.binary(max_size=300))
def test_any_bytes_end_a_switch_of_roles_or_do_not(packet: bytes) -> None:
    assert hci.switched_role(packet, bytes(6)) in (None, *range(256))


def test_roles_are_what_the_kernel_says_and_unknown_without_it(controller: Controller) -> None:
    open_adapter = functools.partial(Adapter, open_socket=controller.open, ioctl=controller.ioctl)
    found = role.Roles(OWN, {"r1": PEER, "r2": "B8:27:EB:00:00:0C"}, open_adapter=open_adapter)
    assert found.of("r1") == ""
    found.look()
    assert (found.of("r1"), found.of("r2")) == ("central", "")
    controller.central = False
    found.look()
    assert found.of("r1") == "peripheral"
    controller.connected.clear()
    found.look()
    assert found.of("r1") == ""
    nowhere = role.Roles("00:00:00:00:00:01", {"r1": PEER}, open_adapter=open_adapter)
    nowhere.look()
    assert nowhere.of("r1") == ""


def test_the_mesh_of_a_robot_may_do_it_and_no_other_service() -> None:
    """The units as they are shipped: the capability in the one drop-in, which systemd reads after the common file."""
    folder = Path(__file__).parents[4] / "deploy/systemd"
    files = {path for path in folder.rglob("*") if path.is_file() and "CAP_NET_RAW" in path.read_text()}
    assert files == {folder / "swarm-mesh.service.d/50-radio.conf"}
    assert sorted(path.name for path in folder.rglob("*.conf"))[0] == "10-common.conf"
