"""The radio's core in virtual time: golden bytes, links, and what ends them."""

import struct
from pathlib import Path
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.radio.core import hci
from lab.radio.core.air import Air
from lab.radio.core.answers import FEATURES
from lab.radio.core.hci import Ev, Op, Status
from lab.radio.trace import Trace
from sim.slots.parameters import SLOT

A, B, C = "02:10:BA:00:00:01", "02:10:BA:00:00:02", "02:10:BA:00:00:03"
KEY = bytes(range(16))
EXCHANGED = 0.5
"""s after which what a host has sent has arrived, over one link."""


def command(op: int, parameters: bytes = b"") -> bytes:
    return bytes((1, op & 0xFF, op >> 8, len(parameters))) + parameters


class World:
    """Three hosts at their controllers, and a clock."""

    def __init__(self) -> None:
        self.air = Air(Random(1), lambda: KEY)
        self.now = 0.0
        self.heard: dict[str, list[bytes]] = {}
        for address in (A, B, C):
            self.heard[address] = []
            self.air.add(address)
            self.tell(address, Op.WRITE_SCAN, b"\3")
            self.heard[address].clear()

    def tell(self, address: str, op: int, parameters: bytes = b"") -> None:
        self.air.receive(address, command(op, parameters), self.now)
        self.collect()

    def collect(self) -> None:
        for address, packet in self.air.to_send():
            self.heard[address].append(packet)

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while (deadline := self.air.next_deadline()) <= end:
            self.now = max(self.now, deadline)
            self.air.handle_timer(self.now)
            self.collect()
        self.now = end
        self.air.handle_timer(end)

    def events(self, address: str) -> list[tuple[int, bytes]]:
        """(code, body) of what came since the last time."""
        packets, self.heard[address] = self.heard[address], []
        return [(packet[1], packet[3:]) for packet in packets if packet[0] == 4]

    def codes(self, address: str) -> list[int]:
        return [code for code, _ in self.events(address)]

    def link(self, caller: str, called: str) -> tuple[int, int]:
        """Make a link; the handles of both sides."""
        self.tell(caller, Op.CREATE_CONNECTION, hci.to_wire(called) + bytes(7))
        self.run(3.0)
        assert self.codes(called)[-1] == Ev.CONNECTION_REQUEST
        self.tell(called, Op.ACCEPT_CONNECTION, hci.to_wire(caller) + b"\1")
        bodies = [dict(self.events(each))[Ev.CONNECTION_COMPLETE] for each in (caller, called)]
        assert all(body[0] == 0 for body in bodies)
        one, other = (int.from_bytes(body[1:3], "little") for body in bodies)
        return one, other

    def data(self, address: str, handle: int, payload: bytes) -> None:
        self.air.receive(address, b"\2" + hci.acl(handle, 0, payload)[1:], self.now)
        self.collect()

    def arrived(self, address: str) -> list[bytes]:
        packets = [packet[5:] for packet in self.heard[address] if packet[0] == 2]
        self.heard[address] = [packet for packet in self.heard[address] if packet[0] != 2]
        return packets


@pytest.fixture
def world() -> World:
    return World()


def result(world: World, address: str, op: int, handle: int) -> bytes:
    """What a command about a link gives, from its status on."""
    world.events(address)
    world.tell(address, op, handle.to_bytes(2, "little"))
    ((_, body),) = world.events(address)
    return body[3:]


def test_roles_are_those_of_the_call_until_a_host_has_them_switched(world: World) -> None:
    one, other = world.link(A, B)
    assert (result(world, A, Op.ROLE_DISCOVERY, one)[3], result(world, B, Op.ROLE_DISCOVERY, other)[3]) == (0, 1)
    world.tell(B, Op.SWITCH_ROLE, hci.to_wire(A) + b"\0")
    world.run(EXCHANGED)
    assert world.events(A) == [(Ev.ROLE_CHANGE, b"\0" + hci.to_wire(B) + b"\1")]
    assert world.events(B)[-1] == (Ev.ROLE_CHANGE, b"\0" + hci.to_wire(A) + b"\0")
    assert (result(world, A, Op.ROLE_DISCOVERY, one)[3], result(world, B, Op.ROLE_DISCOVERY, other)[3]) == (1, 0)
    # The time-out is the central's to set.
    slots = (3200).to_bytes(2, "little")
    world.tell(A, Op.WRITE_SUPERVISION, one.to_bytes(2, "little") + slots)
    world.tell(B, Op.WRITE_SUPERVISION, other.to_bytes(2, "little") + slots)
    assert [world.events(each)[-1][1][3] for each in (A, B)] == [Status.COMMAND_DISALLOWED, 0]
    world.tell(A, Op.SWITCH_ROLE, hci.to_wire(C) + b"\0")
    assert world.events(A)[-1] == (Ev.COMMAND_STATUS, hci.status(Op.SWITCH_ROLE, Status.UNKNOWN_CONNECTION)[3:])


def test_a_link_tells_its_signal(world: World) -> None:
    one, _ = world.link(A, B)
    world.air.change(rssi=-60)
    assert result(world, A, Op.READ_RSSI, one)[3:] == b"\xc4"
    assert result(world, A, Op.READ_QUALITY, one)[3:] == b"\xff"
    assert result(world, A, Op.READ_FAILED_CONTACTS, one)[3:] == b"\0\0"
    assert result(world, A, Op.READ_RSSI, 999)[0] == Status.UNKNOWN_CONNECTION


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


def test_data_goes_both_ways_and_is_counted(world: World) -> None:
    one, other = world.link(A, B)
    assert one != other
    world.data(A, one, b"there")
    world.data(B, other, b"back")
    assert world.arrived(A) == world.arrived(B) == []
    world.run(EXCHANGED)
    assert world.arrived(B) == [b"there"]
    assert world.arrived(A) == [b"back"]
    assert world.codes(A) == world.codes(B) == [Ev.COMPLETED_PACKETS]
    assert world.air.links() == [(A, B)]


def test_data_takes_its_slots(world: World) -> None:
    one, _ = world.link(A, B)
    for _ in range(8):
        world.data(A, one, bytes(1000))
    packets = 8 * -(-1000 // 679)  # of five slots at most, with one for the answer
    world.run(packets * 4 * SLOT)
    assert len(world.arrived(B)) < 8
    world.run(1.0)
    assert len(world.codes(A)) == 8


def test_a_bridge_shares_its_time(world: World) -> None:
    """What it gets waits for its stay, far longer than from a poll to the next one."""

    def slowest(sender: str, handle: int, receiver: str) -> float:
        times = []
        for _ in range(20):
            world.data(sender, handle, b"x")
            began = world.now
            while not world.arrived(receiver):
                world.run(0.005)
            times.append(world.now - began)
        return max(times)

    one, _ = world.link(A, B)
    alone = slowest(A, one, B)
    world.link(C, B)
    assert slowest(A, one, B) > 2 * alone


def test_a_short_cut_loses_nothing(world: World) -> None:
    one, _ = world.link(A, B)
    world.air.cut(A, B)
    world.data(A, one, b"kept")
    world.run(19.0)
    assert world.arrived(B) == []
    assert world.codes(A) == []  # not counted either: the host waits
    world.air.mend(A, B)
    world.run(EXCHANGED)
    assert world.arrived(B) == [b"kept"]
    world.run(30.0)
    assert world.air.links() == [(A, B)]


@pytest.mark.parametrize("how", ["cut", "silence", "place"])
def test_a_long_silence_ends_the_link_on_both_sides(world: World, how: str) -> None:
    one, other = world.link(A, B)
    world.air.change(supervision=4.0, range=10.0)
    if how == "cut":
        world.air.cut(A, B)
    elif how == "silence":
        world.air.silence(B)
    else:
        world.air.place(A, 0, 0)
        world.air.place(B, 10.1, 0)
    world.run(3.9)
    assert world.events(A) == []
    world.run(0.2)
    assert world.events(A) == [(Ev.DISCONNECTION_COMPLETE, hci.disconnected(one, Status.CONNECTION_TIMEOUT)[3:])]
    assert world.events(B) == [(Ev.DISCONNECTION_COMPLETE, hci.disconnected(other, Status.CONNECTION_TIMEOUT)[3:])]
    assert world.air.links() == []


def test_who_has_paged_sets_how_long_a_silent_link_is_kept(world: World) -> None:
    one, other = world.link(A, B)
    world.tell(B, Op.WRITE_SUPERVISION, struct.pack("<HH", other, 3200))
    world.tell(A, Op.WRITE_SUPERVISION, struct.pack("<HH", one + 1, 3200))
    world.tell(A, Op.WRITE_SUPERVISION, struct.pack("<HH", one, 3200))  # 2 s
    (refused,) = world.events(B)
    assert refused[1][3:] == struct.pack("<BH", Status.COMMAND_DISALLOWED, other)
    assert [body[3] for _, body in world.events(A)] == [Status.UNKNOWN_CONNECTION, Status.SUCCESS]
    world.air.cut(A, B)
    world.run(1.9)
    assert world.events(A) == []
    world.run(0.2)
    assert world.codes(A) == world.codes(B) == [Ev.DISCONNECTION_COMPLETE]


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


def test_a_disconnect_arrives_after_the_data_before_it(world: World) -> None:
    one, _ = world.link(A, B)
    world.data(A, one, b"last words")
    world.tell(A, Op.DISCONNECT, one.to_bytes(2, "little") + b"\x13")
    assert world.codes(A) == [Ev.COMMAND_STATUS]
    world.run(EXCHANGED)
    assert world.arrived(B) == [b"last words"]
    assert [body[3] for _, body in world.events(B)] == [0x13]
    assert [(code, body[-1]) for code, body in world.events(A)] == [
        (Ev.COMPLETED_PACKETS, 0),
        (Ev.DISCONNECTION_COMPLETE, Status.LOCAL_HOST_TERMINATED),
    ]
    assert world.air.links() == []


def test_a_lost_adapter_is_noticed_by_supervision_and_can_come_back(world: World) -> None:
    one, _ = world.link(A, B)
    world.air.remove(B)
    world.data(A, one, b"to nobody")
    world.air.add(B)
    world.tell(B, Op.WRITE_SCAN, b"\3")
    # It knows nothing of the link, the other side still has it.
    world.tell(B, Op.CREATE_CONNECTION, hci.to_wire(A) + bytes(7))
    world.run(2.0)
    assert [body[0] for code, body in world.events(B) if code == Ev.CONNECTION_COMPLETE] == [Status.CONNECTION_EXISTS]
    world.run(20.0)
    assert world.codes(A)[-1] == Ev.DISCONNECTION_COMPLETE
    world.link(B, A)


def test_a_reset_forgets_links(world: World) -> None:
    world.link(A, B)
    world.tell(A, Op.RESET)
    world.run(20.0)
    assert world.codes(B) == [Ev.DISCONNECTION_COMPLETE]
    assert world.codes(A) == [Ev.COMMAND_COMPLETE]
    assert world.air.links() == []


def test_a_controller_that_its_host_switched_off_is_heard_no_more(world: World) -> None:
    world.link(A, B)
    world.air.switch_off(A)
    world.run(20.0)
    assert world.codes(A) == []
    assert [(code, body[-1]) for code, body in world.events(B)] == [
        (Ev.DISCONNECTION_COMPLETE, Status.CONNECTION_TIMEOUT)
    ]
    assert world.air.links() == []
    world.tell(B, Op.CREATE_CONNECTION, hci.to_wire(A) + bytes(7))
    world.run(20.0)
    assert world.events(B)[-1][1][0] == Status.PAGE_TIMEOUT  # it does not listen


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


def pair(world: World, answer: dict[int, tuple[int, bytes]]) -> dict[str, list[tuple[int, bytes]]]:
    """Both hosts answer each question by that table until none is left: what else they heard."""
    rest: dict[str, list[tuple[int, bytes]]] = {A: [], B: []}
    busy = True
    while busy:
        busy = False
        for address in (A, B):
            for code, body in world.events(address):
                if code in answer:
                    op, more = answer[code]
                    world.tell(address, op, body[:6] + more)
                    busy = True
                elif code not in (Ev.COMMAND_COMPLETE, Ev.COMMAND_STATUS):
                    rest[address].append((code, body))
    return rest


def test_simple_pairing_gives_both_the_key_and_next_time_it_is_enough(world: World) -> None:
    for address in (A, B):
        world.tell(address, Op.WRITE_SIMPLE_PAIRING, b"\1")
    one, _ = world.link(A, B)
    handle = one.to_bytes(2, "little")
    world.tell(A, Op.AUTHENTICATION_REQUESTED, handle)
    answers = {
        Ev.LINK_KEY_REQUEST: (Op.LINK_KEY_NEGATIVE_REPLY, b""),
        Ev.IO_CAPABILITY_REQUEST: (Op.IO_CAPABILITY_REPLY, b"\3\0\2"),
        Ev.CONFIRMATION_REQUEST: (Op.CONFIRM, b""),
    }
    rest = pair(world, answers)
    assert [code for code, _ in rest[A]] == [
        *(Ev.IO_CAPABILITY_RESPONSE, Ev.SIMPLE_PAIRING_COMPLETE, Ev.LINK_KEY, Ev.AUTHENTICATION_COMPLETE),
    ]
    for address in (A, B):
        assert dict(rest[address])[Ev.LINK_KEY][6:] == KEY + b"\x04"
    assert dict(rest[A])[Ev.AUTHENTICATION_COMPLETE] == b"\0" + handle
    world.tell(A, Op.AUTHENTICATION_REQUESTED, handle)
    assert pair(world, {Ev.LINK_KEY_REQUEST: (Op.LINK_KEY_REPLY, KEY)})[A] == [
        (Ev.AUTHENTICATION_COMPLETE, b"\0" + handle)
    ]
    world.tell(A, Op.SET_ENCRYPTION, handle + b"\1")
    assert dict(world.events(B))[Ev.ENCRYPTION_CHANGE][3] == 1
    assert world.air.encrypted() == [(A, B)]
    world.tell(A, Op.SET_ENCRYPTION, handle + b"\0")
    assert world.air.encrypted() == []


def test_both_hosts_that_authenticate_one_link_at_once_hear_how_it_ended(world: World) -> None:
    one, other = world.link(A, B)
    for address, handle in ((A, one), (B, other)):
        world.tell(address, Op.AUTHENTICATION_REQUESTED, handle.to_bytes(2, "little"))
    rest = pair(world, {Ev.LINK_KEY_REQUEST: (Op.LINK_KEY_REPLY, KEY)})
    for address, handle in ((A, one), (B, other)):
        assert rest[address] == [(Ev.AUTHENTICATION_COMPLETE, b"\0" + handle.to_bytes(2, "little"))]


def test_golden_bytes_of_pairing_and_encryption(world: World) -> None:
    """As btmon shows them: reversed addresses, the key, its type (unauthenticated), the handle."""
    heard: dict[str, list[str]] = {A: [], B: []}
    for address in (A, B):
        world.tell(address, Op.WRITE_SIMPLE_PAIRING, b"\1")
    one, other = world.link(A, B)
    assert (one, other) == (1, 65)

    def say(who: str, op: int, more: bytes = b"") -> None:
        world.tell(who, op, (hci.to_wire(B if who == A else A) if op != Op.AUTHENTICATION_REQUESTED else b"") + more)
        for address in (A, B):
            rows = [bytes((code,)) + body for code, body in world.events(address)]
            heard[address] += [row.hex() for row in rows if row[0] not in (Ev.COMMAND_COMPLETE, Ev.COMMAND_STATUS)]

    say(A, Op.AUTHENTICATION_REQUESTED, b"\1\0")
    say(A, Op.LINK_KEY_NEGATIVE_REPLY)
    say(A, Op.IO_CAPABILITY_REPLY, b"\3\0\2")
    say(B, Op.IO_CAPABILITY_REPLY, b"\3\0\2")
    say(A, Op.CONFIRM)
    say(B, Op.CONFIRM)
    first, second = "010000ba1002", "020000ba1002"
    key = KEY.hex() + "04"
    assert heard[A] == [
        *("17" + second, "31" + second, "32" + second + "030002", "33" + second + "40e20100"),
        *("3600" + second, "18" + second + key, "06000100"),
    ]
    assert heard[B] == [
        *("32" + first + "030002", "31" + first, "33" + first + "40e20100"),
        *("3600" + first, "18" + first + key),
    ]
    world.tell(A, Op.SET_ENCRYPTION, b"\1\0\1")
    assert [body.hex() for code, body in world.events(A) if code == Ev.ENCRYPTION_CHANGE] == ["00010001"]
    assert [body.hex() for code, body in world.events(B) if code == Ev.ENCRYPTION_CHANGE] == ["00410001"]


def test_no_encryption_without_a_key(world: World) -> None:
    one, _ = world.link(A, B)
    world.tell(A, Op.SET_ENCRYPTION, one.to_bytes(2, "little") + b"\1")
    assert dict(world.events(A))[Ev.ENCRYPTION_CHANGE] == bytes((Status.KEY_MISSING, one, 0, 0))
    assert world.events(B) == []
    assert world.air.encrypted() == []


@pytest.mark.parametrize(
    ("refusal", "code"),
    [
        ({Ev.IO_CAPABILITY_REQUEST: (Op.IO_CAPABILITY_NEGATIVE_REPLY, b"\x18")}, Status.PAIRING_NOT_ALLOWED),
        (
            {
                Ev.IO_CAPABILITY_REQUEST: (Op.IO_CAPABILITY_REPLY, b"\3\0\2"),
                Ev.CONFIRMATION_REQUEST: (Op.CONFIRM_NEGATIVE, b""),
            },
            Status.AUTHENTICATION_FAILURE,
        ),
    ],
)
def test_who_does_not_want_to_pair_does_not(world: World, refusal: dict[int, tuple[int, bytes]], code: int) -> None:
    for address in (A, B):
        world.tell(address, Op.WRITE_SIMPLE_PAIRING, b"\1")
    one, _ = world.link(A, B)
    world.tell(A, Op.AUTHENTICATION_REQUESTED, one.to_bytes(2, "little"))
    rest = pair(world, {Ev.LINK_KEY_REQUEST: (Op.LINK_KEY_NEGATIVE_REPLY, b""), **refusal})
    assert dict(rest[A])[Ev.AUTHENTICATION_COMPLETE][0] == code
    assert Ev.LINK_KEY not in dict(rest[B])


@pytest.mark.parametrize(("second", "code"), [(b"1234", 0), (b"9999", Status.AUTHENTICATION_FAILURE)])
def test_two_devices_pair_only_if_their_pins_agree(world: World, second: bytes, code: int) -> None:
    one, _ = world.link(A, B)
    world.tell(A, Op.AUTHENTICATION_REQUESTED, one.to_bytes(2, "little"))
    world.tell(A, Op.LINK_KEY_NEGATIVE_REPLY, hci.to_wire(B))
    for address, other, pin in ((A, B, b"1234"), (B, A, second)):
        world.tell(address, Op.PIN_REPLY, hci.to_wire(other) + bytes((4,)) + pin.ljust(16, b"\0"))
    assert dict(world.events(A))[Ev.AUTHENTICATION_COMPLETE][0] == code


@given(st.binary(max_size=80))
def test_no_bytes_of_a_host_break_the_parser(data: bytes) -> None:
    try:
        packets, rest = hci.split(data)
    except hci.HciError:
        return
    assert b"".join(packets) + rest == data
    for packet in packets:
        hci.parse(packet)


steps = st.one_of(
    st.tuples(st.just("data"), st.booleans()),
    st.tuples(st.just("cut"), st.booleans()),
    st.tuples(st.just("run"), st.floats(0.0, 1.0)),
)


@given(st.lists(steps, max_size=60))
def test_whatever_happens_below_the_supervision_time_nothing_is_lost_doubled_or_reordered(
    plan: list[tuple[str, object]],
) -> None:
    world = World()
    handles = world.link(A, B)
    world.air.change(supervision=1000.0)
    sent: dict[str, list[bytes]] = {A: [], B: []}
    for what, value in plan:
        if what == "data":
            sender, handle, receiver = (A, handles[0], B) if value else (B, handles[1], A)
            sent[receiver].append(len(sent[receiver]).to_bytes(2, "little"))
            world.data(sender, handle, sent[receiver][-1])
        elif what == "cut":
            (world.air.cut if value else world.air.mend)(A, B)
        else:
            world.run(float(str(value)))
    world.air.mend(A, B)
    world.collect()
    world.run(60.0)
    assert world.arrived(A) == sent[A]
    assert world.arrived(B) == sent[B]
    done = [len([code for code in world.codes(each) if code == Ev.COMPLETED_PACKETS]) for each in (A, B)]
    assert done == [len(sent[B]), len(sent[A])]
