"""What /dev/i2c-N answers to its ioctls (linux/i2c-dev.h, linux/i2c.h), without IO, over anything that carries
messages: an adapter like the Raspberry Pi's, which speaks plain I2C and has SMBus emulated by the kernel
(drivers/i2c/i2c-core-smbus.c)."""

import errno
import os
import struct
from enum import IntEnum
from typing import NamedTuple, Protocol

from lab.i2c.cuse import Call, Memory


class Command(IntEnum):
    """Of ioctls."""

    RETRIES = 0x701
    TIMEOUT = 0x702  # in units of 10 ms
    SLAVE = 0x703
    TENBIT = 0x704
    FUNCS = 0x705
    SLAVE_FORCE = 0x706
    RDWR = 0x707
    PEC = 0x708
    SMBUS = 0x720


class Size(IntEnum):
    """Of SMBus transfers; block reads and block process calls are not among what is emulated."""

    QUICK = 0
    BYTE = 1
    BYTE_DATA = 2
    WORD_DATA = 3
    PROC_CALL = 4
    BLOCK_DATA = 5
    I2C_BLOCK_DATA = 8


FUNCTIONALITY = 0x0EFF0009
"""I2C_FUNC_I2C and I2C_FUNC_SMBUS_EMUL, as i2c-bcm2835 reports."""
READ = 1
"""Flag of a message."""
MOST_MESSAGES = 42
"""I2C_RDWR_IOCTL_MAX_MSGS."""
LONGEST = 8192
"""Bytes of one message."""

SMBUS_BLOCK = 32

_RDWR_DATA = struct.Struct("<QI4x")
_MESSAGE = struct.Struct("<HHH2xQ")
_SMBUS_DATA = struct.Struct("<BB2xIQ")
_LONG = struct.Struct("<Q")
_BLOCK = SMBUS_BLOCK + 2


class Message(NamedTuple):
    """START or repeated START, the address, and bytes in one direction."""

    address: int
    write: bytes = b""
    read: int = 0
    """Bytes to be read; where it is 0, `write` is written."""


class Adapter(Protocol):
    """Carries the messages of one transfer, ended by a STOP."""

    timeout_s: float
    """After which it gives a transfer up."""

    def transfer(self, messages: list[Message]) -> bytes:
        """What was read, all messages' bytes in a row. Raises OSError: 121, 110, 5."""


class I2CDevice:
    """See the module; a `Device` for `lab.i2c.cuse.Cuse`."""

    def __init__(self, adapter: Adapter) -> None:
        self._adapter = adapter
        self._addresses: dict[int, int] = {}

    def ioctl(self, call: Call, memory: Memory) -> int:
        """One ioctl; see `lab.i2c.cuse.Device`."""
        match call.command:
            case Command.RDWR:
                return self._messages(call, memory)
            case Command.SMBUS:
                self._smbus(call, memory)
            case Command.SLAVE | Command.SLAVE_FORCE if call.argument <= 0x7F:
                self._addresses[call.handle] = call.argument
            case Command.FUNCS:
                memory.write(call.argument, _LONG.pack(FUNCTIONALITY))
            case Command.TIMEOUT:
                self._adapter.timeout_s = call.argument * 0.01
            case Command.RETRIES:
                pass
            case Command.TENBIT | Command.PEC if not call.argument:
                pass
            case Command.SLAVE | Command.SLAVE_FORCE | Command.TENBIT | Command.PEC:
                raise failure(errno.EINVAL)
            case _:
                raise failure(errno.ENOTTY)
        return 0

    def close(self, handle: int) -> None:
        """See `lab.i2c.cuse.Device`."""
        self._addresses.pop(handle, None)

    def _messages(self, call: Call, memory: Memory) -> int:
        where, count = _RDWR_DATA.unpack(memory.read(call.argument, _RDWR_DATA.size))
        if not 0 < count <= MOST_MESSAGES:
            raise failure(errno.EINVAL)
        heads = [*_MESSAGE.iter_unpack(memory.read(where, count * _MESSAGE.size))]
        messages = []
        for address, flags, length, pointer in heads:
            if length > LONGEST or flags & ~READ:
                raise failure(errno.EINVAL)
            if flags & READ:
                messages.append(Message(address, read=length))
            else:
                messages.append(Message(address, memory.read(pointer, length)))
        data, at = self._adapter.transfer(messages), 0
        for _, flags, length, pointer in heads:
            if flags & READ:
                memory.write(pointer, data[at : at + length])
                at += length
        return len(heads)

    def _smbus(self, call: Call, memory: Memory) -> None:
        reads, command, size, where = _SMBUS_DATA.unpack(memory.read(call.argument, _SMBUS_DATA.size))
        address = self._addresses.get(call.handle)
        if address is None or reads > 1:
            raise failure(errno.EINVAL)
        takes, fills = _smbus_union(reads, size)
        messages, lead = _emulated(address, reads, command, size, memory.read(where, takes))
        data = lead + self._adapter.transfer(messages)
        memory.write(where, data.ljust(fills, b"\0"))


def _smbus_union(reads: int, size: int) -> tuple[int, int]:
    """How much of union i2c_smbus_data is taken in, and filled. OSError 95 for what the adapter does not offer."""
    match size:
        case Size.QUICK:
            return 0, 0
        case Size.BYTE:
            return 0, reads
        case Size.BYTE_DATA | Size.WORD_DATA:
            return (0, size - 1) if reads else (size - 1, 0)
        case Size.PROC_CALL:
            return 2, 2
        case Size.BLOCK_DATA if not reads:
            return _BLOCK, 0
        case Size.I2C_BLOCK_DATA:  # a read, too, gives its length in the union
            return _BLOCK, _BLOCK if reads else 0
        case _:
            raise failure(errno.EOPNOTSUPP)


def _emulated(address: int, reads: int, command: int, size: int, union: bytes) -> tuple[list[Message], bytes]:
    """The messages that stand for it, and what comes before their bytes in the answer."""
    index = bytes((command,))
    match size:
        case Size.QUICK:
            return [Message(address)], b""
        case Size.BYTE:
            return [Message(address, read=1) if reads else Message(address, index)], b""
        case Size.BYTE_DATA | Size.WORD_DATA if reads:
            return [Message(address, index), Message(address, read=size - 1)], b""
        case Size.BYTE_DATA | Size.WORD_DATA:
            return [Message(address, index + union)], b""
        case Size.PROC_CALL:
            return [Message(address, index + union), Message(address, read=2)], b""
    count = union[0]
    if not 0 < count <= SMBUS_BLOCK:
        raise failure(errno.EINVAL)
    if size == Size.BLOCK_DATA:
        return [Message(address, index + union[: 1 + count])], b""
    if reads:
        return [Message(address, index), Message(address, read=count)], union[:1]
    return [Message(address, index + union[1 : 1 + count])], b""


def failure(number: int) -> OSError:
    """What the kernel says by that number."""
    return OSError(number, os.strerror(number))
