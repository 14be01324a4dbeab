"""What a recording has taken and not yet put into its file, kept where it survives the process: a mapped file in the
runtime directory, which is memory on a robot. A process killed by -9 loses nothing by it, and nobody waits for a disk.

Two halves take turns: one grows while the other is being written to the recording. Each begins with the offset in the
recording at which its records are due, and their length; 0 = they are there.
"""

import mmap
import os
import struct
from pathlib import Path

HALF = 512 * 1024
"""Bytes of records, two of these. A second at 1 kHz takes a quarter of it."""

_HEAD = struct.Struct("<QQ")
_LENGTH = struct.Struct("<Q")


class Journal:
    """The file. Raises `OSError` where it cannot be made."""

    def __init__(self, path: Path) -> None:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o664)
        try:
            os.ftruncate(file, 2 * HALF)
            self._map = mmap.mmap(file, 2 * HALF)
        finally:
            os.close(file)
        self._half = 0
        self._length = 0

    def left(self) -> list[tuple[int, bytes]]:
        """Offset and records of the halves that never reached the recording, in order."""
        found = []
        for at in (0, HALF):
            base, length = _HEAD.unpack_from(self._map, at)
            if 0 < length <= HALF - _HEAD.size:
                found.append((base, self._map[at + _HEAD.size : at + _HEAD.size + length]))
        return sorted(found)

    def clear(self) -> None:
        """Forget what both halves hold."""
        for at in (0, HALF):
            _LENGTH.pack_into(self._map, at + 8, 0)
        self._length = 0

    def turn(self, base: int) -> None:
        """From now on add to the other half, whose records are due at `base`."""
        self._half = HALF - self._half
        self._length = 0
        _HEAD.pack_into(self._map, self._half, base, 0)

    def stored(self) -> None:
        """The half that is not added to has reached the recording."""
        _LENGTH.pack_into(self._map, HALF - self._half + 8, 0)

    def add(self, record: bytes) -> None:
        """Keep a record; where the half is full (since the disk is), nothing in it counts any more."""
        end = self._length + len(record)
        if end > HALF - _HEAD.size:
            self._length = HALF
            _LENGTH.pack_into(self._map, self._half + 8, 0)
            return
        start = self._half + _HEAD.size
        self._map[start + self._length : start + end] = record
        self._length = end
        _LENGTH.pack_into(self._map, self._half + 8, end)  # last: what is counted is whole

    def close(self) -> None:
        """Let go of the file."""
        self._map.close()
