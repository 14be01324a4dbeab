"""A file of slots that are written in turn, in place, into blocks that were reserved when the file was made.

Each slot holds a sequence number, a length, a checksum and data. A write that a kill or a power cut tears leaves one
slot with a wrong checksum, and those before it count. A disk that is full is found when the file is made, and never
fails a later write. (A new file renamed into place costs 0.02 ms on tmpfs and 0.2 ms on a disk, a write into place
1 us.)
"""

import os
import struct
import zlib
from pathlib import Path

from swarm.errors import LocalError
from swarm.files import open_reserved

_HEAD = struct.Struct("<8sQII")
_MAGIC = b"BLSNAP1\n"


class SlotFile:
    """One file, opened by one process."""

    def __init__(self, path: Path, slots: int, room: int) -> None:
        """`slots`: at least two; the last but one survives a kill in mid-write. `room`: bytes of a slot. Raises
        `LocalError` where the file cannot be made, on a full disk above all."""
        self._path = path
        self._slots = slots
        self._room = room
        self._sequence = 0
        try:
            self._file = open_reserved(path, slots * room, 0o660)
        except OSError as error:
            raise LocalError(f"{path}: cannot have its {slots * room} bytes: {error.strerror}") from None
        self.read()  # the next write goes on behind the newest

    @staticmethod
    def most(room: int) -> int:
        """Return the number of bytes of data that fit into a slot of `room` bytes."""
        return room - _HEAD.size

    @staticmethod
    def fresh(slots: int, room: int) -> bytes:
        """Return the content of a file in which every slot holds empty data."""
        return b"".join(_packed(sequence, b"").ljust(room, b"\0") for sequence in range(slots))

    def read(self) -> list[bytes]:
        """Return the data of the slots that are whole, the newest last."""
        found: dict[int, bytes] = {}
        for slot in range(self._slots):
            magic, sequence, length, check = _HEAD.unpack(os.pread(self._file, _HEAD.size, slot * self._room))
            if magic == _MAGIC and length <= self.most(self._room):
                data = os.pread(self._file, length, slot * self._room + _HEAD.size)
                if _check(sequence, data) == check:
                    found[sequence] = data
        self._sequence = max(found, default=0)
        return [found[sequence] for sequence in sorted(found)]

    def write(self, data: bytes) -> None:
        """Put `data` into the slot of the oldest. Raises `LocalError` where that is impossible."""
        if len(data) > self.most(self._room):
            raise LocalError(f"{self._path}: a slot holds at most {self.most(self._room)} bytes, not {len(data)}")
        self._sequence += 1
        packed = _packed(self._sequence, data)
        try:
            written = os.pwrite(self._file, packed, (self._sequence % self._slots) * self._room)
        except OSError as error:
            raise LocalError(f"{self._path}: {error.strerror}") from None
        if written < len(packed):
            raise LocalError(f"{self._path}: only {written} of {len(packed)} bytes could be written")

    def sync(self) -> None:
        """Wait until what was written is on the disk. Raises `LocalError`."""
        try:
            os.fdatasync(self._file)
        except OSError as error:
            raise LocalError(f"{self._path}: {error.strerror}") from None

    def close(self) -> None:
        """Leave the file for the next process."""
        os.close(self._file)


def _packed(sequence: int, data: bytes) -> bytes:
    return _HEAD.pack(_MAGIC, sequence, len(data), _check(sequence, data)) + data


def _check(sequence: int, data: bytes) -> int:
    return zlib.crc32(data, zlib.crc32(sequence.to_bytes(8, "little")))
