"""Pairing and encryption on the lab's radio."""

import pytest
from radio_world import KEY, A, B, World, world

from lab.radio.core import hci
from lab.radio.core.hci import Ev, Op, Status

__all__ = ["world"]


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
