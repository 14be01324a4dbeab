"""The ioctls of /dev/i2c-N: what a caller's memory must hold, which messages come of it, and what is refused."""

import errno
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lab.i2c.cuse import Call
from lab.i2c.ioctls import FUNCTIONALITY, I2CDevice, Message


class Memory:
    """A caller's memory, and its ioctls."""

    def __init__(self, device: I2CDevice) -> None:
        self._device = device
        self._bytes = bytearray(0x8000)
        self._end = 0x1000

    def put(self, data: bytes) -> int:
        """Its address."""
        at, self._end = self._end, self._end + max(8, len(data))
        self.write(at, data)
        return at

    def read(self, address: int, size: int) -> bytes:
        self._check(address, size)
        return bytes(self._bytes[address : address + size])

    def write(self, address: int, data: bytes) -> None:
        self._check(address, len(data))
        self._bytes[address : address + len(data)] = data

    def _check(self, address: int, size: int) -> None:
        if address + size > len(self._bytes):
            raise OSError(errno.EFAULT, "")

    def ioctl(self, command: int, argument: int = 0, handle: int = 1) -> int:
        return self._device.ioctl(Call(handle, command, argument), self)


def counted(count: int) -> bytes:
    return bytes(number % 256 for number in range(1, 1 + count))


class Wire:
    """An adapter that keeps what it carried; each byte read is one more than the last."""

    def __init__(self) -> None:
        self.timeout_s = 1.0
        self.carried: list[list[Message]] = []
        self.fails: OSError | None = None

    def transfer(self, messages: list[Message]) -> bytes:
        self.carried.append(messages)
        if self.fails is not None:
            raise self.fails
        return counted(sum(message.read for message in messages))


@pytest.fixture
def wire() -> Wire:
    return Wire()


@pytest.fixture
def memory(wire: Wire) -> Memory:
    return Memory(I2CDevice(wire))


def rdwr(memory: Memory, *messages: tuple[int, int, bytes | int]) -> tuple[int, list[bytes]]:
    """I2C_RDWR of (address, flags, bytes to write or number to read); the result, and what each read got."""
    heads, reads = b"", []
    for address, flags, what in messages:
        data = bytes(what) if isinstance(what, int) else what
        at = memory.put(data)
        heads += struct.pack("<HHHxxQ", address, flags, len(data), at)
        if isinstance(what, int):
            reads.append((at, what))
    argument = memory.put(struct.pack("<QIxxxx", memory.put(heads), len(messages)))
    return memory.ioctl(0x707, argument), [memory.read(*read) for read in reads]


def smbus(memory: Memory, reads: int, command: int, size: int, union: bytes = b"") -> bytes:
    """I2C_SMBUS; the union afterwards."""
    memory.ioctl(0x703, 0x14)
    at = memory.put(union.ljust(34, b"\0"))
    assert memory.ioctl(0x720, memory.put(struct.pack("<BBxxIQ", reads, command, size, at))) == 0
    return memory.read(at, 34)


def refused(number: int) -> object:
    return pytest.raises(OSError, match=rf"\[Errno {number}\]")


def test_a_write_and_a_read_of_one_transfer(memory: Memory, wire: Wire) -> None:
    """What smbus2 does for a burst of the IMU."""
    assert rdwr(memory, (0x6B, 0, b"\x22"), (0x6B, 1, 4)) == (2, [b"\x01\x02\x03\x04"])
    assert wire.carried == [[Message(0x6B, b"\x22"), Message(0x6B, read=4)]]


messages = st.lists(
    st.tuples(st.integers(0, 0x7F), st.just(0), st.binary(min_size=1, max_size=40))
    | st.tuples(st.integers(0, 0x7F), st.just(1), st.integers(1, 40)),
    min_size=1,
    max_size=42,
)


@given(messages)
def test_any_messages_arrive_and_each_read_gets_its_own_bytes(wanted: list[tuple[int, int, bytes | int]]) -> None:
    wire = Wire()
    count, got = rdwr(Memory(I2CDevice(wire)), *wanted)
    assert count == len(wanted)
    assert [(each.address, each.read or each.write) for each in wire.carried[0]] == [(a, what) for a, _, what in wanted]
    assert b"".join(got) == counted(sum(map(len, got)))


@pytest.mark.parametrize("number", [errno.EREMOTEIO, errno.ETIMEDOUT, errno.EIO])
def test_a_failed_transfer_is_the_callers(memory: Memory, wire: Wire, number: int) -> None:
    wire.fails = OSError(number, "")
    with refused(number):
        rdwr(memory, (0x14, 0, b"\x04"))


@pytest.mark.parametrize("count", [0, 43])
def test_no_messages_and_too_many_are_refused(memory: Memory, count: int) -> None:
    with refused(errno.EINVAL):
        memory.ioctl(0x707, memory.put(struct.pack("<QIxxxx", 0x1000, count)))


@pytest.mark.parametrize(("flags", "length"), [(0x10, 1), (0, 8193)])
def test_ten_bit_addresses_and_endless_messages_are_refused(memory: Memory, flags: int, length: int) -> None:
    heads = memory.put(struct.pack("<HHHxxQ", 0x14, flags, length, 0x1000))
    with refused(errno.EINVAL):
        memory.ioctl(0x707, memory.put(struct.pack("<QIxxxx", heads, 1)))


@pytest.mark.parametrize(
    ("reads", "command", "size", "union", "carried", "found"),
    [
        (0, 0, 0, b"", [Message(0x14)], b""),
        (0, 9, 1, b"", [Message(0x14, b"\x09")], b""),
        (1, 0, 1, b"", [Message(0x14, read=1)], b"\x01"),
        (0, 9, 2, b"\xaa", [Message(0x14, b"\x09\xaa")], b"\xaa"),
        (1, 9, 2, b"", [Message(0x14, b"\x09"), Message(0x14, read=1)], b"\x01"),
        (0, 9, 3, b"\xaa\xbb", [Message(0x14, b"\x09\xaa\xbb")], b"\xaa\xbb"),
        (1, 9, 3, b"", [Message(0x14, b"\x09"), Message(0x14, read=2)], b"\x01\x02"),
        (0, 9, 4, b"\xaa\xbb", [Message(0x14, b"\x09\xaa\xbb"), Message(0x14, read=2)], b"\x01\x02"),
        (0, 9, 5, b"\x02\xaa\xbb", [Message(0x14, b"\x09\x02\xaa\xbb")], b"\x02\xaa\xbb"),
        (0, 9, 8, b"\x02\xaa\xbb", [Message(0x14, b"\x09\xaa\xbb")], b"\x02\xaa\xbb"),
        (1, 9, 8, b"\x03", [Message(0x14, b"\x09"), Message(0x14, read=3)], b"\x03\x01\x02\x03"),
    ],
)
def test_smbus_is_made_of_messages(
    memory: Memory, wire: Wire, reads: int, command: int, size: int, union: bytes, carried: object, found: bytes
) -> None:
    assert smbus(memory, reads, command, size, union) == found.ljust(34, b"\0")
    assert wire.carried == [carried]


@pytest.mark.parametrize(
    ("reads", "size", "union", "number"),
    [
        (1, 5, b"", errno.EOPNOTSUPP),
        (0, 7, b"\x01\x01", errno.EOPNOTSUPP),
        (0, 9, b"", errno.EOPNOTSUPP),
        (2, 1, b"", errno.EINVAL),
        (0, 8, b"\x00", errno.EINVAL),
        (0, 8, b"\x21", errno.EINVAL),
    ],
)
def test_what_the_adapter_of_a_pi_does_not_offer_is_refused(
    memory: Memory, wire: Wire, reads: int, size: int, union: bytes, number: int
) -> None:
    with refused(number):
        smbus(memory, reads, 9, size, union)
    assert wire.carried == []


def test_smbus_needs_an_address_which_belongs_to_the_open_file(memory: Memory) -> None:
    smbus(memory, 1, 0, 1)
    with refused(errno.EINVAL):
        memory.ioctl(0x720, memory.put(struct.pack("<BBxxIQ", 1, 0, 1, 0x1000)), handle=2)


def test_what_is_asked_and_set(memory: Memory, wire: Wire) -> None:
    at = memory.put(bytes(8))
    assert memory.ioctl(0x705, at) == 0
    assert int.from_bytes(memory.read(at, 8), "little") == FUNCTIONALITY
    memory.ioctl(0x702, 2)
    assert wire.timeout_s == 0.02
    for command, argument in ((0x701, 3), (0x704, 0), (0x708, 0)):
        assert memory.ioctl(command, argument) == 0
    for command, argument, number in (
        *((0x703, 0x80, errno.EINVAL), (0x704, 1, errno.EINVAL)),
        *((0x708, 1, errno.EINVAL), (0x5401, 0, errno.ENOTTY)),
    ):
        with refused(number):
            memory.ioctl(command, argument)


@given(st.integers(0x700, 0x721), st.integers(0, 0x9000) | st.integers(0, 2**64 - 1), st.binary(max_size=200))
def test_no_memory_of_a_caller_breaks_it(command: int, argument: int, data: bytes) -> None:
    memory = Memory(I2CDevice(Wire()))
    memory.ioctl(0x703, 0x14)
    memory.put(data)
    try:
        assert memory.ioctl(command, argument) in range(43)
    except OSError as error:
        assert error.errno in (errno.EINVAL, errno.ENOTTY, errno.EOPNOTSUPP, errno.EFAULT)  # noqa: PT017
