"""A record of all that hosts and controllers say to each other, for `btmon -r FILE` (package bluez).

The format is btsnoop with the data link type of Linux's monitor: one file for all controllers, each with its number.
"""

import struct
import time
from pathlib import Path

from lab.radio.core.hci import Packet

MONITOR = 2001
"""Data link type: each record names its adapter and what it is."""

EPOCH_US = 0x00E03AB44A676000 - 946_684_800_000_000
"""Microseconds from the year 0 to 1970; the format counts from the year 0."""

NEW_ADAPTER = 0
TO_CONTROLLER = {Packet.COMMAND: 2, Packet.ACL: 4}
TO_HOST = {Packet.EVENT: 3, Packet.ACL: 5}
"""Kinds of records, by the type of the packet (bluez, src/shared/btsnoop.h)."""


class Trace:
    """Writes the file; a record is in it as soon as its packet has passed, for the radio may be killed."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb", buffering=0)
        self._file.write(b"btsnoop\0" + struct.pack(">II", 1, MONITOR))

    def adapter(self, number: int, address: str) -> None:
        """An adapter is there from now on."""
        name = f"hci{number}".encode().ljust(8, b"\0")
        self._record(number, NEW_ADAPTER, bytes((0, 0)) + bytes.fromhex(address.replace(":", ""))[::-1] + name)

    def from_host(self, number: int, packet: bytes) -> None:
        """A packet of that adapter's host."""
        self._record(number, TO_CONTROLLER[Packet(packet[0])], packet[1:])

    def to_host(self, number: int, packet: bytes) -> None:
        """A packet for that adapter's host."""
        self._record(number, TO_HOST[Packet(packet[0])], packet[1:])

    def close(self) -> None:
        """Nothing more is written."""
        self._file.close()

    def _record(self, number: int, kind: int, data: bytes) -> None:
        now = time.time_ns() // 1000 + EPOCH_US
        self._file.write(struct.pack(">IIIIq", len(data), len(data), number << 16 | kind, 0, now) + data)
