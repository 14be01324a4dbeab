"""The kernel's CUSE protocol: golden bytes as kernel 6.12 sends and takes them, and everything else it may send."""

import errno
import os
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.i2c.cuse import Call, Cuse, Done, Opcode, Piece, Retry

INIT = bytes.fromhex("38000000 00100000 0100000000000000 0000000000000000 00000000 00000000 00000000 00000000") + (
    bytes.fromhex("07000000 29000000 00000000 01000000")
)
"""7.41, unrestricted ioctls."""


class Answers:
    """A device that says what it was told to, and keeps what it was asked."""

    def __init__(self, answer: Retry | Done | OSError) -> None:
        self.answer, self.calls, self.closed = answer, [], []

    def ioctl(self, call: Call) -> Retry | Done:
        self.calls.append(call)
        if isinstance(self.answer, OSError):
            raise self.answer
        return self.answer

    def close(self, handle: int) -> None:
        self.closed.append(handle)


def request(opcode: int, body: bytes = b"", unique: int = 7) -> bytes:
    return struct.pack("<IIQQIIII", 40 + len(body), opcode, unique, 0, 0, 0, 0, 0) + body


def ioctl(command: int, argument: int = 0, data: bytes = b"", room: int = 0, flags: int = 0) -> bytes:
    return request(Opcode.IOCTL, struct.pack("<QIIQII", 1, flags, command, argument, len(data), room) + data)


def test_init_names_the_device() -> None:
    cuse = Cuse("i2c-1", Answers(Done()))
    assert not cuse.there
    answer = cuse.receive(INIT)
    assert cuse.there
    assert (
        answer
        == bytes.fromhex("66000000 00000000 0100000000000000")
        + bytes.fromhex("07000000 1f000000 00000000 01000000 00100000 00100000 00000000 00000000")
        + bytes(40)
        + b"DEVNAME=i2c-1\0"
    )


def test_a_kernel_without_unrestricted_ioctls_is_refused() -> None:
    with pytest.raises(ValueError, match=r"the kernel speaks 7\.41 with flags 0x0, not 7\.31"):
        Cuse("i2c-1", Answers(Done())).receive(INIT[:-4] + bytes(4))


def test_each_open_file_has_a_handle_of_its_own() -> None:
    device = Answers(Done())
    cuse = Cuse("i2c-1", device)
    first, second = (cuse.receive(request(Opcode.OPEN, bytes(8))) for _ in range(2))
    assert first == bytes.fromhex("20000000 00000000 0700000000000000 0100000000000000 00000000 00000000")
    assert second is not None
    assert second[16:24] == bytes.fromhex("0200000000000000")
    closed = cuse.receive(request(Opcode.RELEASE, bytes.fromhex("0200000000000000") + bytes(16)))
    assert closed == bytes.fromhex("10000000 00000000 0700000000000000")
    assert device.closed == [2]


def test_an_ioctl_asks_for_memory_and_comes_again() -> None:
    device = Answers(Retry([Piece(0x1000, 16)], [Piece(0x2000, 8)]))
    cuse = Cuse("i2c-1", device)
    answer = cuse.receive(ioctl(0x707, 0x1000))
    assert answer == bytes.fromhex(
        "40000000 00000000 0700000000000000"  # header
        "00000000 04000000 01000000 01000000"  # result, RETRY, one piece in, one out
        "0010000000000000 1000000000000000 0020000000000000 0800000000000000"
    )
    device.answer = Done(2, b"filled..")
    again = cuse.receive(ioctl(0x707, 0x1000, b"sixteen bytes...", 8))
    assert (
        again == bytes.fromhex("28000000 00000000 0700000000000000 02000000 00000000 00000000 00000000") + b"filled.."
    )
    assert device.calls == [Call(1, 0x707, 0x1000, b"", 0), Call(1, 0x707, 0x1000, b"sixteen bytes...", 8)]


def test_a_failure_is_the_callers_errno() -> None:
    answer = Cuse("i2c-1", Answers(OSError(errno.EREMOTEIO, "nobody"))).receive(ioctl(0x707))
    assert answer is not None
    assert struct.unpack_from("<iI", answer, 16) == (-121, 0)


def test_a_32_bit_caller_is_refused() -> None:
    device = Answers(Done())
    answer = Cuse("i2c-1", device).receive(ioctl(0x705, flags=1))
    assert answer is not None
    assert struct.unpack_from("<i", answer, 16) == (-errno.ENOTTY,)
    assert device.calls == []


def test_interrupts_are_not_answered_and_the_unknown_is_refused() -> None:
    cuse = Cuse("i2c-1", Answers(Done()))
    assert cuse.receive(request(Opcode.INTERRUPT, bytes(8))) is None
    assert cuse.receive(request(Opcode.FLUSH, bytes(24))) == struct.pack("<IiQ", 16, 0, 7)
    assert cuse.receive(request(15, bytes(40))) == struct.pack("<IiQ", 16, -errno.ENOSYS, 7)


@given(st.binary(max_size=200))
def test_what_is_no_request_is_said_to_be_none(data: bytes) -> None:
    with pytest.raises(ValueError, match="CUSE"):
        Cuse("i2c-1", Answers(Done())).receive(data)


@given(
    st.sampled_from([*Opcode, 1, 15, 16, 40]),
    st.binary(max_size=100),
    st.integers(0, 2**64 - 1),
    st.sampled_from([Done(3, b"x"), Retry([Piece(1, 2)], []), OSError(errno.EIO, os.strerror(errno.EIO))]),
)
def test_every_answer_is_framed_and_has_the_requests_number(
    opcode: int, body: bytes, unique: int, said: Retry | Done | OSError
) -> None:
    try:
        answer = Cuse("i2c-1", Answers(said)).receive(request(opcode, body, unique))
    except ValueError as error:
        assert "CUSE" in str(error)  # noqa: PT017  # which requests are none is the other test's matter
        return
    if answer is not None:
        size, error, same = struct.unpack_from("<IiQ", answer)
        assert (size, same) == (len(answer), unique)
        assert error in (0, -errno.ENOSYS)
