"""The kernel's CUSE protocol: golden bytes as kernel 6.12 sends and takes them, and everything else it may send."""

import errno
import os
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.i2c.cuse import Call, Cuse, Memory, Opcode

INIT = bytes.fromhex("38000000 00100000 0100000000000000 0000000000000000 00000000 00000000 00000000 00000000") + (
    bytes.fromhex("07000000 29000000 00000000 01000000")
)
"""7.41, which could fetch memory (flag 1)."""
CALLER = 4711


class Answers:
    """A device that says what it was told to, and keeps what it was asked; of the caller's memory it fills what comes
    after two bytes with them."""

    def __init__(self, answer: int | OSError) -> None:
        self.answer, self.calls, self.closed = answer, [], []

    def ioctl(self, call: Call, memory: Memory) -> int:
        self.calls.append(call)
        if isinstance(self.answer, OSError):
            raise self.answer
        memory.write(call.argument + 2, memory.read(call.argument, 2))
        return self.answer

    def close(self, handle: int) -> None:
        self.closed.append(handle)


class Caller:
    """Its memory."""

    def __init__(self) -> None:
        self.bytes = bytearray(b"abcd")

    def read(self, address: int, size: int) -> bytes:
        return bytes(self.bytes[address : address + size])

    def write(self, address: int, data: bytes) -> None:
        self.bytes[address : address + len(data)] = data


def serving(device: Answers, caller: Caller | None = None) -> Cuse:
    def memory(process: int) -> Caller:
        if process != CALLER:
            raise ProcessLookupError(errno.ESRCH, "it has gone")
        return caller or Caller()

    return Cuse("i2c-1", device, memory)


def request(opcode: int, body: bytes = b"", unique: int = 7, caller: int = CALLER) -> bytes:
    return struct.pack("<IIQQIIII", 40 + len(body), opcode, unique, 0, 0, 0, caller, 0) + body


def ioctl(command: int, argument: int = 0, flags: int = 0) -> bytes:
    return request(Opcode.IOCTL, struct.pack("<QIIQII", 1, flags, command, argument, 0, 0))


def test_init_names_the_device() -> None:
    cuse = serving(Answers(0))
    assert not cuse.there
    answer = cuse.receive(INIT)
    assert cuse.there
    assert (
        answer
        == bytes.fromhex("66000000 00000000 0100000000000000")
        + bytes.fromhex("07000000 1f000000 00000000 00000000 00100000 00100000 00000000 00000000")
        + bytes(40)
        + b"DEVNAME=i2c-1\0"
    )


def test_an_older_kernel_is_refused() -> None:
    with pytest.raises(ValueError, match=r"the kernel speaks 7\.30, not 7\.31"):
        serving(Answers(0)).receive(INIT.replace(b"\x29", b"\x1e"))


def test_each_open_file_has_a_handle_of_its_own() -> None:
    device = Answers(0)
    cuse = serving(device)
    first, second = (cuse.receive(request(Opcode.OPEN, bytes(8))) for _ in range(2))
    assert first == bytes.fromhex("20000000 00000000 0700000000000000 0100000000000000 00000000 00000000")
    assert second is not None
    assert second[16:24] == bytes.fromhex("0200000000000000")
    closed = cuse.receive(request(Opcode.RELEASE, bytes.fromhex("0200000000000000") + bytes(16)))
    assert closed == bytes.fromhex("10000000 00000000 0700000000000000")
    assert device.closed == [2]


def test_an_ioctl_has_the_callers_memory() -> None:
    device, caller = Answers(2), Caller()
    answer = serving(device, caller).receive(ioctl(0x707))
    assert answer == bytes.fromhex("20000000 00000000 0700000000000000 02000000 00000000 00000000 00000000")
    assert device.calls == [Call(1, 0x707, 0)]
    assert caller.bytes == b"abab"


def test_a_caller_that_was_killed_has_no_memory() -> None:
    device = Answers(2)
    answer = serving(device).receive(request(Opcode.IOCTL, bytes(32), caller=CALLER + 1))
    assert answer is not None
    assert struct.unpack_from("<iI", answer, 16) == (-errno.ESRCH, 0)
    assert device.calls == []


def test_a_failure_is_the_callers_errno() -> None:
    answer = serving(Answers(OSError(errno.EREMOTEIO, "nobody"))).receive(ioctl(0x707))
    assert answer is not None
    assert struct.unpack_from("<iI", answer, 16) == (-121, 0)


def test_a_32_bit_caller_is_refused() -> None:
    device = Answers(0)
    answer = serving(device).receive(ioctl(0x705, flags=1))
    assert answer is not None
    assert struct.unpack_from("<i", answer, 16) == (-errno.ENOTTY,)
    assert device.calls == []


def test_interrupts_are_not_answered_and_the_unknown_is_refused() -> None:
    cuse = serving(Answers(0))
    assert cuse.receive(request(Opcode.INTERRUPT, bytes(8))) is None
    assert cuse.receive(request(Opcode.FLUSH, bytes(24))) == struct.pack("<IiQ", 16, 0, 7)
    assert cuse.receive(request(15, bytes(40))) == struct.pack("<IiQ", 16, -errno.ENOSYS, 7)


@given(st.binary(max_size=200))
def test_what_is_no_request_is_said_to_be_none(data: bytes) -> None:
    with pytest.raises(ValueError, match="CUSE"):
        serving(Answers(0)).receive(data)


@given(
    st.sampled_from([*Opcode, 1, 15, 16, 40]),
    st.binary(max_size=100),
    st.integers(0, 2**64 - 1),
    st.sampled_from([3, OSError(errno.EIO, os.strerror(errno.EIO))]),
)
def test_every_answer_is_framed_and_has_the_requests_number(
    opcode: int, body: bytes, unique: int, said: int | OSError
) -> None:
    try:
        answer = serving(Answers(said)).receive(request(opcode, body, unique))
    except ValueError as error:
        assert "CUSE" in str(error)  # noqa: PT017  # which requests are none is the other test's matter
        return
    if answer is not None:
        size, error, same = struct.unpack_from("<IiQ", answer)
        assert (size, same) == (len(answer), unique)
        assert error in (0, -errno.ENOSYS)
