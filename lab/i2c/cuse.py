"""The kernel's CUSE protocol, without IO: how a character device's open, close and ioctl reach a program, and what it
answers (linux/fuse.h, protocol 7.31; what Debian's 6.12 speaks).

Each request read from /dev/cuse is a header of 40 bytes and a body; each answer a header of 16 bytes and a body. An
ioctl comes without its data, since the kernel cannot know what the argument points at. It would fetch them when told
where they are, in a request more for each step from pointer to pointer; we read and fill the caller's memory ourselves,
since most of what this bus costs is switches between the caller and us.
"""

import errno
import struct
from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple, Protocol


class Opcode(IntEnum):
    """Of requests."""

    OPEN = 14
    RELEASE = 18
    FLUSH = 25
    INTERRUPT = 36
    IOCTL = 39
    INIT = 4096  # CUSE's own


MAJOR, MINOR = 7, 31
IOCTL_COMPAT = 1
"""Flag of a request: from a 32-bit program, whose structures have other sizes."""
LARGEST = 1 << 17
"""Bytes of the largest request that the kernel sends: max_write and its headers are far below."""

_REQUEST = struct.Struct("<IIQQIIII")
_ANSWER = struct.Struct("<IiQ")
_INIT_IN = struct.Struct("<IIII")
_INIT_OUT = struct.Struct("<IIIIIIII40x")
_OPEN_OUT = struct.Struct("<QII")
_IOCTL_IN = struct.Struct("<QIIQII")
_IOCTL_OUT = struct.Struct("<iIII")
_LONGEST = 4096
"""Bytes of a read or a write of the device, of which there are none."""


class Memory(Protocol):
    """Of the process that calls."""

    def read(self, address: int, size: int) -> bytes:
        """So many bytes; `OSError` (EFAULT) where they are not there."""

    def write(self, address: int, data: bytes) -> None:
        """Fill it; `OSError` (EFAULT) where it is not there."""


class Call(NamedTuple):
    """One ioctl."""

    handle: int
    """Of the open file."""
    command: int
    argument: int


class Device(Protocol):
    """What is behind the device file."""

    def ioctl(self, call: Call, memory: Memory) -> int:
        """What it comes back with; raises OSError."""

    def close(self, handle: int) -> None:
        """That file is closed."""


class Cuse:
    """Answers the requests of one device file."""

    def __init__(self, name: str, device: Device, memory: Callable[[int], Memory]) -> None:
        """`name` as in /dev; `memory`: of the process with that id."""
        self._name, self._device, self._memory = name, device, memory
        self._opened = 0
        self.there = False
        """The kernel has asked for the name: /dev has it in a moment."""

    def receive(self, request: bytes) -> bytes | None:
        """The answer; None where there is none. Raises ValueError where that is no request."""
        if len(request) < _REQUEST.size:
            raise ValueError(f"CUSE: a request of {len(request)} bytes")
        size, opcode, unique, _, _, _, caller, _ = _REQUEST.unpack_from(request)
        if size != len(request):
            raise ValueError(f"CUSE: a request of {len(request)} bytes says that it has {size}")
        body = request[_REQUEST.size :]
        try:
            match opcode:
                case Opcode.IOCTL:
                    return _answer(unique, self._ioctl(body, caller))
                case Opcode.INIT:
                    return _answer(unique, self._init(body))
                case Opcode.OPEN:
                    self._opened += 1
                    return _answer(unique, _OPEN_OUT.pack(self._opened, 0, 0))
                case Opcode.RELEASE:
                    self._device.close(int.from_bytes(body[:8], "little"))
                    return _answer(unique)
                case Opcode.FLUSH:
                    return _answer(unique)
                case Opcode.INTERRUPT:  # the caller was sent a signal: what it asked is done in a moment anyway
                    return None
                case _:
                    return _answer(unique, error=errno.ENOSYS)
        except struct.error as error:
            raise ValueError(f"CUSE: a body of {len(body)} bytes with opcode {opcode}: {error}") from None

    def _init(self, body: bytes) -> bytes:
        major, minor, _, _ = _INIT_IN.unpack(body)
        if major != MAJOR or minor < MINOR:
            raise ValueError(f"CUSE: the kernel speaks {major}.{minor}, not {MAJOR}.{MINOR}")
        self.there = True
        answer = _INIT_OUT.pack(MAJOR, MINOR, 0, 0, _LONGEST, _LONGEST, 0, 0)
        return answer + b"DEVNAME=" + self._name.encode() + b"\0"

    def _ioctl(self, body: bytes, caller: int) -> bytes:
        handle, flags, command, argument, _, _ = _IOCTL_IN.unpack(body)
        if flags & IOCTL_COMPAT:
            return _IOCTL_OUT.pack(-errno.ENOTTY, 0, 0, 0)
        try:
            result = self._device.ioctl(Call(handle, command, argument), self._memory(caller))
        except OSError as error:
            result = -(error.errno or errno.EIO)
        return _IOCTL_OUT.pack(result, 0, 0, 0)


def _answer(unique: int, body: bytes = b"", *, error: int = 0) -> bytes:
    return _ANSWER.pack(_ANSWER.size + len(body), -error, unique) + body
