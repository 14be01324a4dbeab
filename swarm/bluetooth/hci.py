"""Bytes of the Host Controller Interface: how strong is the signal of a connection, and how long may it be silent
(Bluetooth Core Specification, volume 4, part E, 7.5.4 Read RSSI, 7.3.42 Write Link Supervision Timeout); and of the
kernel calls around them (Linux: net/bluetooth/hci_sock.h).

All little endian. The kernel lets everybody ask for the signal, root or not: its filter of commands for unprivileged
sockets allows the status parameters. Setting anything takes CAP_NET_RAW.
"""

import errno
import struct
from typing import NamedTuple

from swarm.errors import FrameError, LocalError

COMMAND, EVENT = 1, 4
"""First byte of a packet."""

COMPLETE, STATUS = 0x0E, 0x0F
"""Events that answer a command: Command Complete, Command Status."""

READ_RSSI = 0x05 << 10 | 0x0005
"""Opcode: group 5, status parameters; command 5."""

WRITE_SUPERVISION = 0x03 << 10 | 0x0037
"""Opcode: group 3, controller and baseband; command 0x37."""

SLOT = 0.000625
"""s; the unit of times."""

ACL = 1
"""Type of the connections that RFCOMM runs over."""

NO_CONNECTION = 0x02
"""Status: there is no connection of that handle."""

DEVICE_LIST, DEVICE_INFO, CONNECTION_INFO = 0x800448D2, 0x800448D3, 0x800448D5
"""Requests of ioctl: _IOR('H', 210, int), 211 and 213."""

MAX_DEVICES = 16
DEVICE_INFO_SIZE = 92

SOL_HCI, HCI_FILTER = 0, 2
"""Of setsockopt; from linux/net/bluetooth/hci_sock.h, for not every Python has names for them."""

FILTER = struct.pack("<IIIHxx", 1 << EVENT, 1 << COMPLETE | 1 << STATUS, 0, 0)
"""struct hci_filter, 16 bytes: event packets, of these two kinds, of any command."""

HINTS = {
    errno.EAFNOSUPPORT: "this kernel has no Bluetooth",
    errno.EPERM: "this takes CAP_NET_RAW",
    errno.ENODEV: "the own Bluetooth adapter is not there or switched off (bluetoothctl list)",
    errno.ENETDOWN: "the own Bluetooth adapter is switched off (bluetoothctl power on)",
}
"""What an error of a raw HCI socket means for us."""

_COMMAND = struct.Struct("<BHBH")
_SUPERVISION = struct.Struct("<BHBHH")
_COMPLETE = struct.Struct("<BBBBHBHb")
_STATUS = struct.Struct("<BBBBBH")
_CONNECTION = struct.Struct("<6sBxH6sBBHI")

SUPERVISION_SHARE = 2 / 3
"""Supervision time-out of a connection, of the mesh's own time-out for a silent robot: others that wait for a buffer of
the controller meanwhile must not be taken for dead."""


class RssiReading(NamedTuple):
    """An answer to Read RSSI."""

    status: int
    """0 = fine."""
    handle: int
    rssi: int
    """dB. By the specification how far the signal is above (or, negative, below) the controller's golden range; many
    controllers, Broadcom's among them, give dBm instead."""


def read_rssi(handle: int) -> bytes:
    """The command."""
    return _COMMAND.pack(COMMAND, READ_RSSI, 2, handle)


def write_supervision(handle: int, seconds: float) -> bytes:
    """The command: so long may nothing come over a connection until it is over, up to 40.9 s."""
    slots = round(seconds / SLOT)
    if not 0 < slots <= 0xFFFF:
        raise LocalError(f"a supervision time-out of {seconds:g} s: expected 0.000625 to 40.9")
    return _SUPERVISION.pack(COMMAND, WRITE_SUPERVISION, 4, handle, slots)


def written_supervision(packet: bytes) -> int | None:
    """The status in the answer to it, 0 = fine; None where the packet is something else."""
    if len(packet) >= 7 and packet[:2] == bytes((EVENT, COMPLETE)) and packet[4] | packet[5] << 8 == WRITE_SUPERVISION:
        return packet[6]
    if len(packet) == _STATUS.size and packet[1] == STATUS and _STATUS.unpack(packet)[5] == WRITE_SUPERVISION:
        return packet[3]
    return None


def reading(packet: bytes) -> RssiReading | None:
    """The answer in a packet; None where it is another event. Raises `FrameError` for what is no event at all."""
    if len(packet) < 3 or packet[0] != EVENT or packet[2] != len(packet) - 3:
        raise FrameError(f"HCI packet {packet[:8].hex(' ')}...: no event")
    if packet[1] == COMPLETE and len(packet) >= 6 and packet[4] | packet[5] << 8 == READ_RSSI:
        if len(packet) == 7:  # an error without return parameters
            return RssiReading(packet[6], 0, 0)
        if len(packet) != _COMPLETE.size:
            raise FrameError(f"HCI: Read RSSI answered by {len(packet)} bytes: {_COMPLETE.size} were to come")
        *_, status, handle, rssi = _COMPLETE.unpack(packet)
        return RssiReading(status, handle, rssi)
    if packet[1] == STATUS and len(packet) == _STATUS.size and _STATUS.unpack(packet)[5] == READ_RSSI:
        return RssiReading(packet[3], 0, 0)
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
    """The adapter's address in it, packed."""
    return bytes(filled[10:16])


def connection_info(address: bytes) -> bytearray:
    """struct hci_conn_info_req for the connection to a packed address, with room for the answer."""
    return bytearray(address + bytes((ACL, 0)) + bytes(16))


def connection_handle(filled: bytes | bytearray) -> int:
    """The connection's handle in it."""
    handle: int = _CONNECTION.unpack(bytes(filled))[2]
    return handle


def explained(error: OSError) -> str:
    """What an error of a raw HCI socket means, in words."""
    text, hint = error.strerror or str(error), HINTS.get(error.errno or 0)
    return f"{text}: {hint}" if hint else text
