"""How controllers of the lab's radio find and call each other, in virtual time."""

import struct

import pytest
from radio_world import A, B, C, World, world

from lab.radio.core import hci
from lab.radio.core.hci import Ev, Op, Status
from sim.slots.parameters import SLOT

__all__ = ["world"]


def test_a_page_that_nobody_hears_times_out(world: World) -> None:
    world.tell(A, Op.WRITE_PAGE_TIMEOUT, (1600).to_bytes(2, "little"))  # 1 s
    for absent in ("02:10:BA:00:00:77", B):
        world.air.topology([(B, C)])
        world.events(A)
        world.tell(A, Op.CREATE_CONNECTION, hci.to_wire(absent) + bytes(7))
        world.run(0.9)
        assert world.codes(A) == [Ev.COMMAND_STATUS]
        world.run(0.2)
        assert [body[0] for _, body in world.events(A)] == [Status.PAGE_TIMEOUT]


def test_a_page_is_repeated_until_it_is_heard(world: World) -> None:
    world.air.silence(B)
    world.tell(A, Op.CREATE_CONNECTION, hci.to_wire(B) + bytes(7))
    world.run(3.0)
    assert world.codes(A) == [Ev.COMMAND_STATUS]
    world.air.unsilence(B)
    world.run(2.0)
    assert world.codes(B) == [Ev.CONNECTION_REQUEST]


def test_two_that_call_each_other_have_one_link(world: World) -> None:
    """One answer ends both calls."""
    for one, other in ((A, B), (B, A)):
        world.tell(one, Op.CREATE_CONNECTION, hci.to_wire(other) + bytes(7))
    completed = []
    for _ in range(60):
        world.run(0.1)
        for each, other in ((A, B), (B, A)):
            for code, body in world.events(each):
                if code == Ev.CONNECTION_REQUEST:
                    world.tell(each, Op.ACCEPT_CONNECTION, hci.to_wire(other) + b"\1")
                elif code == Ev.CONNECTION_COMPLETE:
                    completed.append((each, body[0]))
    assert sorted(completed) == [(A, 0), (B, 0)]
    assert world.air.links() == [(A, B)]


def test_a_controller_pages_one_at_a_time(world: World) -> None:
    """The second call's time begins when the first one has ended."""
    world.air.silence(B)
    for other in (B, C):
        world.tell(A, Op.CREATE_CONNECTION, hci.to_wire(other) + bytes(7))
    world.run(5.0)
    assert world.codes(C) == []
    world.run(2.0)
    assert [body[0] for code, body in world.events(A) if code == Ev.CONNECTION_COMPLETE] == [Status.PAGE_TIMEOUT]
    assert world.codes(C) == [Ev.CONNECTION_REQUEST]


def test_a_call_that_is_cancelled_or_rejected_leaves_nothing(world: World) -> None:
    call = hci.to_wire(B) + bytes(7)
    world.tell(A, Op.CREATE_CONNECTION, call)
    world.tell(A, Op.CREATE_CONNECTION_CANCEL, hci.to_wire(B))
    assert world.events(A)[-1] == (Ev.CONNECTION_COMPLETE, hci.connected(Status.UNKNOWN_CONNECTION, 0, B)[3:])
    world.run(6.0)
    assert world.codes(B) == []
    world.tell(A, Op.CREATE_CONNECTION, call)
    world.run(3.0)
    assert world.codes(B) == [Ev.CONNECTION_REQUEST]
    world.tell(B, Op.REJECT_CONNECTION, hci.to_wire(A) + bytes((Status.LIMITED_RESOURCES,)))
    for each, other in ((A, B), (B, A)):
        assert world.events(each)[-1] == (
            Ev.CONNECTION_COMPLETE,
            hci.connected(Status.LIMITED_RESOURCES, 0, other)[3:],
        )
    world.run(6.0)
    assert world.air.links() == []
    world.link(A, B)


def test_who_does_not_answer_a_call_in_time_is_not_linked(world: World) -> None:
    world.tell(A, Op.CREATE_CONNECTION, hci.to_wire(B) + bytes(7))
    world.run(11.0)
    assert world.events(A)[-1] == (Ev.CONNECTION_COMPLETE, hci.connected(Status.ACCEPT_TIMEOUT, 0, B)[3:])
    world.tell(B, Op.ACCEPT_CONNECTION, hci.to_wire(A) + b"\1")
    assert world.events(B)[-1] == (Ev.COMMAND_STATUS, hci.status(Op.ACCEPT_CONNECTION, Status.UNKNOWN_CONNECTION)[3:])


def test_a_controller_scans_for_pages_as_its_host_has_set(world: World) -> None:
    def asked(op: int) -> bytes:
        world.events(A)
        world.tell(A, op)
        return world.events(A)[0][1][3:]

    slots = struct.pack("<HH", 512, 18)
    assert asked(Op.READ_PAGE_SCAN_ACTIVITY) == b"\0" + struct.pack("<HH", 0x0800, 0x0012)
    assert world.air.scans()[A] == 1.28
    world.tell(A, Op.WRITE_PAGE_SCAN_ACTIVITY, slots)
    world.tell(A, Op.WRITE_PAGE_SCAN_TYPE, b"\1")
    assert asked(Op.READ_PAGE_SCAN_ACTIVITY) == b"\0" + slots
    assert asked(Op.READ_PAGE_SCAN_TYPE) == b"\0\1"
    assert world.air.calls.scans[A] == (512 * SLOT, 36 * SLOT)
    world.tell(A, Op.WRITE_SCAN, b"\0")
    assert A not in world.air.calls.reachable
    world.tell(A, Op.RESET)
    assert world.air.scans()[A] == 1.28
    assert asked(Op.READ_PAGE_SCAN_TYPE) == b"\0\0"


def test_who_scans_more_often_is_met_sooner(world: World) -> None:
    def mean(called: str) -> float:
        total = 0.0
        for _ in range(20):
            world.tell(A, Op.CREATE_CONNECTION, hci.to_wire(called) + bytes(7))
            began = world.now
            while Ev.CONNECTION_REQUEST not in world.codes(called):
                world.run(0.01)
            total += world.now - began
            world.tell(A, Op.CREATE_CONNECTION_CANCEL, hci.to_wire(called))
            world.run(1.0 + world.now % 0.37)
        return total / 20

    world.tell(B, Op.WRITE_PAGE_SCAN_ACTIVITY, struct.pack("<HH", 512, 18))
    assert 2 * mean(B) < mean(C)


def test_an_inquiry_finds_those_that_can_be_found(world: World) -> None:
    world.tell(C, Op.WRITE_SCAN, b"\2")
    world.tell(A, Op.INQUIRY, b"\x33\x8b\x9e\x02\0")
    world.run(3.0)
    events = world.events(A)
    assert [code for code, _ in events] == [Ev.COMMAND_STATUS, Ev.INQUIRY_RESULT_RSSI, Ev.INQUIRY_COMPLETE]
    assert events[1][1][1:7] == hci.to_wire(B)


@pytest.mark.parametrize(("linked", "status"), [(True, 0), (False, Status.PAGE_TIMEOUT)])
def test_a_linked_robot_that_hears_no_pages_says_its_name(world: World, linked: bool, status: int) -> None:
    if linked:
        world.link(A, B)
    world.tell(B, Op.WRITE_SCAN, b"\0")
    world.tell(A, Op.REMOTE_NAME, hci.to_wire(B) + bytes(4))
    world.run(6.0)
    assert dict(world.events(A))[Ev.REMOTE_NAME_COMPLETE][0] == status


def test_an_inquiry_before_a_reset_says_nothing_after_it(world: World) -> None:
    world.tell(A, Op.INQUIRY, b"\x33\x8b\x9e\x08\0")
    world.run(1.0)
    world.tell(A, Op.RESET)
    world.tell(A, Op.INQUIRY, b"\x33\x8b\x9e\x08\0")
    world.events(A)
    world.run(9.5)
    assert Ev.INQUIRY_COMPLETE not in world.codes(A)
    world.run(1.0)
    assert world.codes(A) == [Ev.INQUIRY_COMPLETE]


def test_the_pages_of_a_lost_adapter_end_with_it(world: World) -> None:
    world.air.cut(A, B)
    world.tell(A, Op.CREATE_CONNECTION, hci.to_wire(B) + bytes(7))
    world.run(0.5)
    world.air.remove(A)
    world.air.add(A)
    world.events(A)
    world.air.mend(A, B)
    world.run(20.0)
    assert world.codes(B) == []
    assert world.codes(A) == []
