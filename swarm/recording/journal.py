"""The messages of a recording that are not yet in its file, kept in a mapped file in the runtime directory, which is
memory on a robot. A process killed by -9 loses none of them, and nobody waits for a disk.

Two halves take turns: one grows while the other is being written to the recording. Each begins with the offset in the
recording at which its records are due, and their length; 0 = they are there. Before the halves stands a mark that says
whether they count: one store takes both away. Behind the mark stands which file the records belong to: several runs of
an app use one journal after the other. The file owns all its blocks from the start on: a page of a mapped file
for which a full disk has no block ends the process with SIGBUS.
"""

import hashlib
import mmap
import os
import struct
from pathlib import Path

from swarm.files import open_reserved

HALF = 512 * 1024
"""Bytes of records, two of these. A second at 1 kHz takes a quarter of it."""

_MARK = b"BLJOUR1\n"
_FIRST = 16
"""Offset of the first half."""
_SIZE = _FIRST + 2 * HALF

NO_OWNER = bytes(_FIRST - len(_MARK))
"""The owner of records where the recording could not be opened."""

_HEAD = struct.Struct("<QQ")
_LENGTH = struct.Struct("<Q")


def owner_of(recording: int) -> bytes:
    """Return 8 bytes that tell the open file of a recording from all others on this computer, until it boots."""
    found = os.fstat(recording)
    return hashlib.blake2b(f"{found.st_dev} {found.st_ino}".encode(), digest_size=_FIRST - len(_MARK)).digest()


class Journal:
    """The file. Raises `OSError` where it cannot be made, on a full disk above all."""

    def __init__(self, path: Path) -> None:
        file = open_reserved(path, _SIZE, 0o664)
        try:
            self._map = mmap.mmap(file, _SIZE)
        finally:
            os.close(file)
        self._half = _FIRST
        self._length = 0

    def left(self, owner: bytes) -> list[tuple[int, bytes]]:
        """Offset and records of the halves that never reached the recording that `owner_of` describes, in order."""
        found: list[tuple[int, bytes]] = []
        if self._map[:_FIRST] != _MARK + owner:
            return found
        for at in (_FIRST, _FIRST + HALF):
            base, length = _HEAD.unpack_from(self._map, at)
            if 0 < length <= HALF - _HEAD.size:
                found.append((base, self._map[at + _HEAD.size : at + _HEAD.size + length]))
        return sorted(found)

    def begin(self, base: int, owner: bytes) -> None:
        """Forget what both halves hold, which has reached the recording, and begin with records of `owner` that are due
        at `base`."""
        self._map[: len(_MARK)] = bytes(len(_MARK))
        self._half, self._length = _FIRST, 0
        self._map[_FIRST : _FIRST + _HEAD.size] = _HEAD.pack(base, 0)
        self._set_length(self._other, 0)
        self._map[len(_MARK) : _FIRST] = owner
        self._map[: len(_MARK)] = _MARK

    def turn(self, base: int) -> None:
        """Add to the other half from now on; its records are due at `base`."""
        self._half = self._other
        self._length = 0
        self._map[self._half : self._half + _HEAD.size] = _HEAD.pack(base, 0)

    def stored(self) -> None:
        """The half that is not added to has reached the recording."""
        self._set_length(self._other, 0)

    def add(self, record: bytes) -> None:
        """Keep a record; where the half is full (since the disk is), nothing in it counts any more."""
        end = self._length + len(record)
        if end > HALF - _HEAD.size:
            self._length = HALF
            self._set_length(self._half, 0)
            return
        start = self._half + _HEAD.size
        self._map[start + self._length : start + end] = record
        self._length = end
        self._set_length(self._half, end)  # last: what is counted is whole

    def close(self) -> None:
        """Let go of the file."""
        self._map.close()

    @property
    def _other(self) -> int:
        """Offset of the half that is not added to."""
        return 2 * _FIRST + HALF - self._half

    def _set_length(self, half: int, length: int) -> None:
        self._map[half + 8 : half + 16] = _LENGTH.pack(length)
