"""The newest snapshot of an app, kept through kill -9 (rule R5) at the price of one small write an iteration.

The file has slots, written in turn, and so holds the last few snapshots (a change of epoch may go back to an earlier
one): sequence, length, checksum, data. A write that a kill cut short leaves a slot with a wrong checksum, and the one
before it, whose successor was never sent, counts. All space is reserved when the file is opened, so a full disk is
found then and not in mid-run. (A new file renamed into place costs 0.02 ms on tmpfs and 0.2 ms on a disk, a write into
place 1 us; lockstep iterations are of 1 ms.) It outlives the process, not the machine: no fsync.
"""

import os
import struct
import zlib
from pathlib import Path

from swarm.errors import AppError, LocalError

_HEAD = struct.Struct("<8sQII")
_MAGIC = b"BLSNAP1\n"
_SLOT = 64 * 1024
MAX_SNAPSHOT = _SLOT - _HEAD.size
"""Largest snapshot, bytes: states take at most 440 each, so nearly all of it is the app's private fields'."""


class SnapshotFile:
    """`RUNTIME/app.<name>.snapshot`, opened for one process."""

    def __init__(self, path: Path, slots: int = 2) -> None:
        """`slots`: at least two; the last but one survives a kill in mid-write. Raises `LocalError` where the file
        cannot be made, on a full disk above all."""
        self._path = path
        self._slots = slots
        self._sequence = 0
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o660)
        except OSError as error:
            raise LocalError(f"{path}: {error.strerror}") from None
        try:
            os.posix_fallocate(self._file, 0, slots * _SLOT)
        except OSError as error:
            os.close(self._file)
            raise LocalError(f"{path}: no space for snapshots of {slots * _SLOT} bytes: {error.strerror}") from None

    def read(self) -> list[bytes]:
        """The whole snapshots in the file, the newest last."""
        found: dict[int, bytes] = {}
        for slot in range(self._slots):
            magic, sequence, length, check = _HEAD.unpack(os.pread(self._file, _HEAD.size, slot * _SLOT))
            if magic == _MAGIC and length <= MAX_SNAPSHOT:
                data = os.pread(self._file, length, slot * _SLOT + _HEAD.size)
                if _check(sequence, data) == check:
                    found[sequence] = data
        self._sequence = max(found, default=0)
        return [found[sequence] for sequence in sorted(found)]

    def write(self, data: bytes) -> None:
        """Keep `data` in place of the oldest. Raises `LocalError` where that is impossible."""
        if len(data) > MAX_SNAPSHOT:
            raise AppError(
                f"the private state makes a snapshot of {len(data)} bytes, at most {MAX_SNAPSHOT} can be kept"
            )
        self._sequence += 1
        head = _HEAD.pack(_MAGIC, self._sequence, len(data), _check(self._sequence, data))
        try:
            written = os.pwrite(self._file, head + data, (self._sequence % self._slots) * _SLOT)
        except OSError as error:
            raise LocalError(f"{self._path}: {error.strerror}") from None
        if written < len(head) + len(data):
            raise LocalError(f"{self._path}: only {written} of {len(head) + len(data)} bytes could be written")

    def close(self) -> None:
        """Leave the file for the next process."""
        os.close(self._file)


def _check(sequence: int, data: bytes) -> int:
    return zlib.crc32(data, zlib.crc32(sequence.to_bytes(8, "little")))
