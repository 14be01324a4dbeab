"""Bytes of the Host Controller Interface: what a connection's radio tells, which side is its central, and how long it
may be silent (Bluetooth Core Specification, volume 4, part E, 7.5 status parameters, 7.2.8 Switch Role, 7.3.42 Write
Link Supervision Timeout); and of the kernel calls around them (Linux: net/bluetooth/hci_sock.h).

All little endian. The kernel lets everybody ask for status parameters and roles, root or not: its filter of commands
for unprivileged sockets allows them. Setting anything takes CAP_NET_RAW.
"""

import errno
import struct
from typing import NamedTuple

from swarm.errors import FrameError, LocalError

COMMAND, EVENT = 1, 4
"""First byte of a packet."""

COMPLETE, STATUS, ROLE_CHANGE = 0x0E, 0x0F, 0x12
"""Events that answer a command: Command Complete, Command Status, and what follows Switch Role."""

READ_FAILED_CONTACTS, READ_QUALITY, READ_RSSI = (0x05 << 10 | command for command in (0x0001, 0x0003, 0x0005))
"""Opcodes: group 5, status parameters."""

SWITCH_ROLE = 0x02 << 10 | 0x000B
"""Opcode: group 2, link policy; command 11."""

WRITE_SUPERVISION = 0x03 << 10 | 0x0037
"""Opcode: group 3, controller and baseband; command 0x37."""

SLOT = 0.000625
"""s; the unit of times."""

ACL = 1
"""Type of the connections that RFCOMM runs over."""

UNKNOWN_COMMAND, NO_CONNECTION = 0x01, 0x02
"""Status: the adapter does not know the command; there is no connection of that handle."""

CENTRAL, PERIPHERAL = 0, 1
"""Roles, as commands and events have them."""

DEVICE_LIST, DEVICE_INFO, CONNECTION_INFO = 0x800448D2, 0x800448D3, 0x800448D5
"""Requests of ioctl: _IOR('H', 210, int), 211 and 213."""

MAX_DEVICES = 16
DEVICE_INFO_SIZE = 92

SOL_HCI, HCI_FILTER = 0, 2
"""Constants of setsockopt from linux/net/bluetooth/hci_sock.h; not every Python has names for them."""

FILTER = struct.pack("<IIIHxx", 1 << EVENT, 1 << COMPLETE | 1 << STATUS | 1 << ROLE_CHANGE, 0, 0)
"""struct hci_filter, 16 bytes: event packets, of these three kinds, of any command."""

HINTS = {
    errno.EAFNOSUPPORT: "this kernel has no Bluetooth",
    errno.EPERM: "this takes CAP_NET_RAW",
    errno.ENODEV: "the own Bluetooth adapter is not there or switched off (bluetoothctl list)",
    errno.ENETDOWN: "the own Bluetooth adapter is switched off (bluetoothctl power on)",
}
"""What an error of a raw HCI socket means for us."""

_COMMAND = struct.Struct("<BHBH")
_SUPERVISION = struct.Struct("<BHBHH")
_SWITCH = struct.Struct("<BHB6sB")
_ROLE = struct.Struct("<BBBB6sB")
_COMPLETE = {READ_FAILED_CONTACTS: "<BBBBHBHH", READ_QUALITY: "<BBBBHBHB", READ_RSSI: "<BBBBHBHb"}
_STATUS = struct.Struct("<BBBBBH")
_CONNECTION = struct.Struct("<6sBxH6sBBHI")
_CONNECTED = (1, 7)
"""States of a connection: BT_CONNECTED, BT_CONFIG."""
_LINK_CENTRAL = 1
"""Bit of a connection's link mode (HCI_LM_MASTER)."""

SUPERVISION_SHARE = 2 / 3
"""Supervision time-out of a connection, of the mesh's own time-out for a silent robot: others that wait for a buffer of
the controller meanwhile must not be taken for dead."""


class Reading(NamedTuple):
    """An answer to one of the commands that read a status parameter."""

    status: int
    """0 = fine."""
    handle: int
    value: int
    """RSSI in dB: by the specification how far the signal is above (or, negative, below) the controller's golden range;
    many controllers, Broadcom's among them, give dBm instead. Link quality: 0 to 255, higher is better, each maker has
    its own measure. Failed contacts: packets in a row that were given up without an answer; 0 where packets never
    expire, as is usual."""


def read(what: int, handle: int) -> bytes:
    """Return the command with that opcode."""
    return _COMMAND.pack(COMMAND, what, 2, handle)


def switch_role(address: bytes, role: int) -> bytes:
    """Return the command: have that role in the connection to a packed address."""
    return _SWITCH.pack(COMMAND, SWITCH_ROLE, 7, address, role)


def switched_role(packet: bytes, address: bytes) -> int | None:
    """Return the status at the end of such a switch, 0 = fine; None where the packet is something else."""
    if len(packet) == _ROLE.size and packet[:2] == bytes((EVENT, ROLE_CHANGE)):
        _, _, _, status, peer, _ = _ROLE.unpack(packet)
        return int(status) if peer == address else None
    if len(packet) == _STATUS.size and packet[1] == STATUS and _STATUS.unpack(packet)[5] == SWITCH_ROLE:
        return packet[3] or None  # 0: its end is to come
    return None


def write_supervision(handle: int, seconds: float) -> bytes:
    """Return the command: so long may nothing come over a connection until it is over, up to 40.9 s."""
    slots = round(seconds / SLOT)
    if not 0 < slots <= 0xFFFF:
        raise LocalError(f"a supervision time-out of {seconds:g} s: expected 0.000625 to 40.9")
    return _SUPERVISION.pack(COMMAND, WRITE_SUPERVISION, 4, handle, slots)


def written_supervision(packet: bytes) -> int | None:
    """Return the status in the answer to it, 0 = fine; None where the packet is something else."""
    if len(packet) >= 7 and packet[:2] == bytes((EVENT, COMPLETE)) and packet[4] | packet[5] << 8 == WRITE_SUPERVISION:
        return packet[6]
    if len(packet) == _STATUS.size and packet[1] == STATUS and _STATUS.unpack(packet)[5] == WRITE_SUPERVISION:
        return packet[3]
    return None


def reading(packet: bytes, what: int = READ_RSSI) -> Reading | None:
    """Return the answer to the command with that opcode; None where the packet is another event. Raises `FrameError`
    for what is no event at all."""
    if len(packet) < 3 or packet[0] != EVENT or packet[2] != len(packet) - 3:
        raise FrameError(f"HCI packet {packet[:8].hex(' ')}...: no event")
    if packet[1] == COMPLETE and len(packet) >= 6 and packet[4] | packet[5] << 8 == what:
        if len(packet) == 7:  # an error without return parameters
            return Reading(packet[6], 0, 0)
        layout = _COMPLETE[what]
        if len(packet) != struct.calcsize(layout):
            size = struct.calcsize(layout)
            raise FrameError(f"HCI: command {what:#06x} answered by {len(packet)} bytes: {size} were to come")
        *_, status, handle, value = struct.unpack(layout, packet)
        return Reading(status, handle, value)
    if packet[1] == STATUS and len(packet) == _STATUS.size and _STATUS.unpack(packet)[5] == what:
        return Reading(packet[3], 0, 0)
    return None


def packed_address(text: str) -> bytes:
    """B8:27:EB:12:34:56 as the kernel has it: the last byte first."""
    try:
        data = bytes.fromhex(text.replace(":", ""))[::-1]
    except ValueError:
        data = b""
    if len(data) != 6:
        raise LocalError(f"Bluetooth address {text!r}: expected six bytes like B8:27:EB:12:34:56")
    return data


def device_list() -> bytearray:
    """struct hci_dev_list_req, empty, with room for all."""
    return bytearray(struct.pack("<H", MAX_DEVICES) + bytes(2 + 8 * MAX_DEVICES))


def devices(filled: bytes | bytearray) -> list[int]:
    """Numbers of the adapters in it."""
    (count,) = struct.unpack_from("<H", filled)
    return [struct.unpack_from("<H", filled, 4 + 8 * n)[0] for n in range(min(count, MAX_DEVICES))]


def device_info(number: int) -> bytearray:
    """struct hci_dev_info of one adapter, empty."""
    return bytearray(struct.pack("<H", number) + bytes(DEVICE_INFO_SIZE - 2))


def device_address(filled: bytes | bytearray) -> bytes:
    """Return the adapter's address in it, packed."""
    return bytes(filled[10:16])


def connection_info(address: bytes) -> bytearray:
    """struct hci_conn_info_req for the connection to a packed address, with room for the answer."""
    return bytearray(address + bytes((ACL, 0)) + bytes(16))


def connection_handle(filled: bytes | bytearray) -> int:
    """Return the connection's handle in it."""
    handle: int = _CONNECTION.unpack(bytes(filled))[2]
    return handle


def is_connected(filled: bytes | bytearray) -> bool:
    """Return whether the connection in it has been made; else it is being made, or ends."""
    return _CONNECTION.unpack(bytes(filled))[6] in _CONNECTED


def is_central(filled: bytes | bytearray) -> bool:
    """Return whether the own adapter is the central of the connection in it."""
    mode: int = _CONNECTION.unpack(bytes(filled))[7]
    return bool(mode & _LINK_CENTRAL)


def explained(error: OSError) -> str:
    """Explain an error of a raw HCI socket in words."""
    text, hint = error.strerror or str(error), HINTS.get(error.errno or 0)
    return f"{text}: {hint}" if hint else text
