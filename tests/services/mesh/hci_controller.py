"""A stand-in for the kernel's raw HCI sockets: adapters, one connection, and the packets that follow a command."""

import errno
import os
import socket
import struct
from collections.abc import Callable

from swarm.bluetooth import hci

ADAPTERS = {0: "00:1A:7D:DA:71:13", 3: "B8:27:EB:00:00:0A"}
PEER = "B8:27:EB:00:00:0B"
HANDLE = 0x000B


class Controller:
    """Adapters and one connection; `answers` makes the packets that follow a command about its handle."""

    def __init__(self) -> None:
        self.connected = {hci.packed_address(PEER): HANDLE}
        self.values = [-60]
        self.answers: Callable[[int], list[bytes]] = self.in_order
        self.bound: int | None = None
        self.filtered = b""
        self.sockets: list[HciSocket] = []
        self.asked: list[bytes] = []
        self.refuses: OSError | None = None
        self.state = 1
        """Of the connection: 5 = being paged, 7 = being set up, 1 = there."""
        self.central = True
        """Whether the own adapter is the central of the connection."""
        self.switches: int | None = 0
        """The status at the end of a switch of roles; None = its end never comes."""

    def __enter__(self) -> "Controller":
        return self

    def __exit__(self, *_: object) -> None:
        for sock in self.sockets:
            sock.close()

    def in_order(self, handle: int) -> list[bytes]:
        value = self.values.pop(0) if len(self.values) > 1 else self.values[0]
        return [complete(handle, value)]

    def open(self) -> "HciSocket":
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        made = HciSocket(self, ours.detach(), theirs)
        self.sockets.append(made)
        return made

    def ioctl(self, sock: object, request: int, buffer: bytearray) -> int:
        match request:
            case hci.DEVICE_LIST:
                buffer[:2] = struct.pack("<H", len(ADAPTERS))
                for place, number in enumerate(ADAPTERS):
                    buffer[4 + 8 * place : 6 + 8 * place] = struct.pack("<H", number)
            case hci.DEVICE_INFO:
                (number,) = struct.unpack_from("<H", buffer)
                buffer[10:16] = hci.packed_address(ADAPTERS[number])
            case hci.CONNECTION_INFO:
                if buffer[6] != hci.ACL or bytes(buffer[:6]) not in self.connected:
                    raise OSError(errno.ENOENT, os.strerror(errno.ENOENT))
                buffer[8:10] = struct.pack("<H", self.connected[bytes(buffer[:6])])
                buffer[18:24] = struct.pack("<HI", self.state, self.central)
        return 0


class HciSocket(socket.socket):
    def __init__(self, controller: Controller, fileno: int, other: socket.socket) -> None:
        super().__init__(socket.AF_UNIX, socket.SOCK_SEQPACKET, 0, fileno)
        self.controller = controller
        self.other = other

    def bind(self, address: object) -> None:
        (self.controller.bound,) = address  # type: ignore[misc]

    def setsockopt(self, level: int, option: int, value: object) -> None:  # type: ignore[override]
        assert (level, option) == (hci.SOL_HCI, hci.HCI_FILTER)
        self.controller.filtered = value  # type: ignore[assignment]

    def send(self, data: bytes, flags: int = 0) -> int:  # type: ignore[override]
        if self.controller.refuses is not None:
            raise self.controller.refuses
        kind, _, length, handle = struct.unpack_from("<BHBH", data)
        assert (kind, length) == (hci.COMMAND, len(data) - 4)
        self.controller.asked.append(data)
        if data[1:3] == struct.pack("<H", hci.SWITCH_ROLE):
            self.other.send(bytes.fromhex("04 0f 04 00 01 0b 08"))
            if self.controller.switches is not None:
                self.controller.central = self.controller.switches == 0
                role = bytes((hci.EVENT, hci.ROLE_CHANGE, 8, self.controller.switches))
                self.other.send(role + data[4:10] + bytes((not self.controller.central,)))
            return len(data)
        for packet in self.controller.answers(handle):
            self.other.send(packet)
        return len(data)

    def close(self) -> None:
        self.other.close()
        super().close()


def complete(handle: int, value: int, status: int = 0) -> bytes:
    return struct.pack("<BBBBHBHb", hci.EVENT, hci.COMPLETE, 7, 1, hci.READ_RSSI, status, handle, value)
