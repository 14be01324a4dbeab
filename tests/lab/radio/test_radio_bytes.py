"""What hosts and controllers of the lab's radio say to each other, byte for byte."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from radio_world import A, World, command, world

from lab.radio.core import hci
from lab.radio.core.answers import FEATURES
from lab.radio.core.hci import Ev, Op
from lab.radio.trace import Trace

__all__ = ["world"]


def test_events_of_the_controller_have_these_bytes() -> None:
    assert hci.complete(Op.RESET).hex() == "040e0401030c00"
    assert hci.status(Op.CREATE_CONNECTION).hex() == "040f0400010504"
    assert hci.connected(0, 1, A).hex() == "04030b00010001" + "0000ba1002" + "0100"
    assert hci.disconnected(0x41, 8).hex() == "04050400410008"
    assert hci.completed(0x41).hex() == "0413050141000100"
    assert hci.acl(0x41, 0, b"xy").hex() == "02412002007879"
    assert hci.acl(0x41, 1, b"xy").hex() == "02411002007879"
    assert hci.parse(bytes.fromhex("01030c00")) == hci.Command(Op.RESET, b"")
    assert hci.parse(bytes.fromhex("02410002007879")) == hci.Acl(0x41, 0, b"xy")
    assert hci.from_wire(hci.to_wire(A)) == A
    assert FEATURES.hex() == "2700004000000880"


def test_golden_bytes_of_a_trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.time_ns", lambda: 946_684_800_000_000_000)  # the year 2000, by which the format counts
    trace = Trace(tmp_path / "trace")
    trace.adapter(1, A)
    trace.from_host(1, command(Op.RESET))
    trace.to_host(1, hci.complete(Op.RESET))
    trace.close()
    data = (tmp_path / "trace").read_bytes()
    assert data[:16].hex() == "6274736e6f6f7000" + "00000001" + "000007d1"
    record = "{0:08x}{0:08x}0001{1:04x}00000000" + "00e03ab44a676000"
    adapter = record.format(16, 0) + "0000" + "010000ba1002" + b"hci1".hex() + "00000000"
    reset = record.format(3, 2) + "030c00"
    completed = record.format(6, 3) + "0e0401030c00"
    assert data[16:].hex() == adapter + reset + completed


def test_a_host_that_starts_learns_what_its_controller_can(world: World) -> None:
    world.tell(A, Op.READ_ADDRESS)
    assert world.events(A) == [(Ev.COMMAND_COMPLETE, bytes.fromhex("01091000") + hci.to_wire(A))]
    world.tell(A, 0x2003)  # of LE, which we do not have
    assert world.events(A) == [(Ev.COMMAND_COMPLETE, bytes.fromhex("01032001"))]
    assert world.air.counts["unknown_2003"] == 1


@given(st.binary(max_size=80))
def test_no_bytes_of_a_host_break_the_parser(data: bytes) -> None:
    try:
        packets, rest = hci.split(data)
    except hci.HciError:
        return
    assert b"".join(packets) + rest == data
    for packet in packets:
        hci.parse(packet)
