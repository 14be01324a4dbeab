"""Links of the lab's radio in virtual time: their data, and what ends them."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from radio_world import A, B, C, World, result, world

from lab.radio.core import hci
from lab.radio.core.hci import Ev, Op, Status
from sim.slots.parameters import SLOT

__all__ = ["world"]

EXCHANGED = 0.5
"""s after which what a host has sent has arrived, over one link."""


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
