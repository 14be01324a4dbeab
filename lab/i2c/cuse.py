"""The kernel's CUSE protocol, without IO: how a character device's open, close and ioctl reach a program, and what it
answers (linux/fuse.h, protocol 7.31; what Debian's 6.12 speaks).

Each request read from /dev/cuse is a header of 40 bytes and a body; each answer a header of 16 bytes and a body. An
ioctl comes without its data, since the kernel cannot know what the argument points at: the program says which pieces of
the caller's memory it wants to read and to fill (`Retry`), and gets the request anew with them.
"""

import errno
import struct
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
UNRESTRICTED_IOCTL = 1
"""Flag of INIT: we may `Retry`."""
IOCTL_COMPAT = 1
"""Flag of a request: from a 32-bit program, whose structures have other sizes."""
IOCTL_RETRY = 4
"""Flag of an answer."""
LARGEST = 1 << 17
"""Bytes of the largest request that the kernel sends: max_write and its headers are far below."""

_REQUEST = struct.Struct("<IIQQIIII")
_ANSWER = struct.Struct("<IiQ")
_INIT_IN = struct.Struct("<IIII")
_INIT_OUT = struct.Struct("<IIIIIIII40x")
_OPEN_OUT = struct.Struct("<QII")
_IOCTL_IN = struct.Struct("<QIIQII")
_IOCTL_OUT = struct.Struct("<iIII")
_PIECE = struct.Struct("<QQ")
_LONGEST_PIECE = 4096


class Piece(NamedTuple):
    """Of the caller's memory."""

    address: int
    size: int


class Call(NamedTuple):
    """One ioctl."""

    handle: int
    """Of the open file."""
    command: int
    argument: int
    data: bytes
    """The pieces asked for, one after the other; empty at first."""
    room: int
    """Bytes of the pieces that are to be filled; 0 at first."""


class Retry(NamedTuple):
    """Ask again with these pieces."""

    read: list[Piece]
    fill: list[Piece]


class Done(NamedTuple):
    """What an ioctl comes back with; OSError for one that fails."""

    result: int = 0
    fill: bytes = b""


class Device(Protocol):
    """What is behind the device file."""

    def ioctl(self, call: Call) -> Retry | Done:
        """Raises OSError; called again after a `Retry`."""

    def close(self, handle: int) -> None:
        """That file is closed."""


class Cuse:
    """Answers the requests of one device file."""

    def __init__(self, name: str, device: Device) -> None:
        """`name` as in /dev."""
        self._name, self._device = name, device
        self._opened = 0
        self.there = False
        """The kernel has asked for the name: /dev has it in a moment."""

    def receive(self, request: bytes) -> bytes | None:
        """The answer; None where there is none. Raises ValueError where that is no request."""
        if len(request) < _REQUEST.size:
            raise ValueError(f"CUSE: a request of {len(request)} bytes")
        size, opcode, unique, *_ = _REQUEST.unpack_from(request)
        if size != len(request):
            raise ValueError(f"CUSE: a request of {len(request)} bytes says that it has {size}")
        body = request[_REQUEST.size :]
        try:
            match opcode:
                case Opcode.IOCTL:
                    return _answer(unique, self._ioctl(body))
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
        major, minor, _, flags = _INIT_IN.unpack(body)
        if major != MAJOR or minor < MINOR or not flags & UNRESTRICTED_IOCTL:
            raise ValueError(f"CUSE: the kernel speaks {major}.{minor} with flags {flags:#x}, not {MAJOR}.{MINOR}")
        self.there = True
        answer = _INIT_OUT.pack(MAJOR, MINOR, 0, UNRESTRICTED_IOCTL, _LONGEST_PIECE, _LONGEST_PIECE, 0, 0)
        return answer + b"DEVNAME=" + self._name.encode() + b"\0"

    def _ioctl(self, body: bytes) -> bytes:
        handle, flags, command, argument, size, room = _IOCTL_IN.unpack_from(body)
        data = body[_IOCTL_IN.size :]
        if len(data) != size:
            raise ValueError(f"CUSE: an ioctl with {len(data)} bytes of data says that it has {size}")
        if flags & IOCTL_COMPAT:
            return _IOCTL_OUT.pack(-errno.ENOTTY, 0, 0, 0)
        try:
            answer = self._device.ioctl(Call(handle, command, argument, data, room))
        except OSError as error:
            return _IOCTL_OUT.pack(-(error.errno or errno.EIO), 0, 0, 0)
        if isinstance(answer, Done):
            return _IOCTL_OUT.pack(answer.result, 0, 0, 0) + answer.fill
        head = _IOCTL_OUT.pack(0, IOCTL_RETRY, len(answer.read), len(answer.fill))
        return head + b"".join(_PIECE.pack(*piece) for piece in (*answer.read, *answer.fill))


def _answer(unique: int, body: bytes = b"", *, error: int = 0) -> bytes:
    return _ANSWER.pack(_ANSWER.size + len(body), -error, unique) + body
