"""Packets between a Bluetooth host and its controller (Core specification 5.4, vol 4 part E), after a type byte (H4).

All numbers are little endian; addresses are written XX:XX:XX:XX:XX:XX and travel reversed.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum


class HciError(ValueError):
    """These bytes are no packet that a host may send."""


class Packet(IntEnum):
    """The type byte (vol 4 part A, 2)."""

    COMMAND = 1
    ACL = 2
    EVENT = 4


class Op(IntEnum):
    """Commands that a controller of ours does something for: group << 10 | number (vol 4 part E, 7)."""

    INQUIRY = 0x0401
    INQUIRY_CANCEL = 0x0402
    CREATE_CONNECTION = 0x0405
    DISCONNECT = 0x0406
    CREATE_CONNECTION_CANCEL = 0x0408
    ACCEPT_CONNECTION = 0x0409
    REJECT_CONNECTION = 0x040A
    LINK_KEY_REPLY = 0x040B
    LINK_KEY_NEGATIVE_REPLY = 0x040C
    PIN_REPLY = 0x040D
    PIN_NEGATIVE_REPLY = 0x040E
    CHANGE_PACKET_TYPE = 0x040F
    AUTHENTICATION_REQUESTED = 0x0411
    SET_ENCRYPTION = 0x0413
    REMOTE_NAME = 0x0419
    REMOTE_NAME_CANCEL = 0x041A
    READ_REMOTE_FEATURES = 0x041B
    READ_REMOTE_EXTENDED_FEATURES = 0x041C
    READ_REMOTE_VERSION = 0x041D
    IO_CAPABILITY_REPLY = 0x042B
    CONFIRM = 0x042C
    CONFIRM_NEGATIVE = 0x042D
    IO_CAPABILITY_NEGATIVE_REPLY = 0x0434
    ROLE_DISCOVERY = 0x0809
    SWITCH_ROLE = 0x080B
    RESET = 0x0C03
    READ_STORED_LINK_KEY = 0x0C0D
    DELETE_STORED_LINK_KEY = 0x0C12
    WRITE_NAME = 0x0C13
    READ_NAME = 0x0C14
    READ_ACCEPT_TIMEOUT = 0x0C15
    WRITE_PAGE_TIMEOUT = 0x0C18
    READ_SCAN = 0x0C19
    WRITE_SCAN = 0x0C1A
    READ_PAGE_SCAN_ACTIVITY = 0x0C1B
    WRITE_PAGE_SCAN_ACTIVITY = 0x0C1C
    READ_CLASS = 0x0C23
    WRITE_CLASS = 0x0C24
    READ_VOICE = 0x0C25
    WRITE_SUPERVISION = 0x0C37
    READ_IAC_COUNT = 0x0C38
    READ_IACS = 0x0C39
    READ_PAGE_SCAN_TYPE = 0x0C46
    WRITE_PAGE_SCAN_TYPE = 0x0C47
    READ_SIMPLE_PAIRING = 0x0C55
    WRITE_SIMPLE_PAIRING = 0x0C56
    READ_INQUIRY_POWER = 0x0C58
    READ_VERSION = 0x1001
    READ_COMMANDS = 0x1002
    READ_FEATURES = 0x1003
    READ_EXTENDED_FEATURES = 0x1004
    READ_BUFFER_SIZE = 0x1005
    READ_ADDRESS = 0x1009
    READ_FAILED_CONTACTS = 0x1401
    READ_QUALITY = 0x1403
    READ_RSSI = 0x1405
    READ_KEY_SIZE = 0x1408


class Ev(IntEnum):
    """Events (vol 4 part E, 7.7)."""

    INQUIRY_COMPLETE = 0x01
    CONNECTION_COMPLETE = 0x03
    CONNECTION_REQUEST = 0x04
    DISCONNECTION_COMPLETE = 0x05
    AUTHENTICATION_COMPLETE = 0x06
    REMOTE_NAME_COMPLETE = 0x07
    ENCRYPTION_CHANGE = 0x08
    REMOTE_FEATURES_COMPLETE = 0x0B
    REMOTE_VERSION_COMPLETE = 0x0C
    COMMAND_COMPLETE = 0x0E
    COMMAND_STATUS = 0x0F
    ROLE_CHANGE = 0x12
    COMPLETED_PACKETS = 0x13
    PIN_REQUEST = 0x16
    LINK_KEY_REQUEST = 0x17
    LINK_KEY = 0x18
    PACKET_TYPE_CHANGED = 0x1D
    INQUIRY_RESULT_RSSI = 0x22
    REMOTE_EXTENDED_FEATURES_COMPLETE = 0x23
    IO_CAPABILITY_REQUEST = 0x31
    IO_CAPABILITY_RESPONSE = 0x32
    CONFIRMATION_REQUEST = 0x33
    SIMPLE_PAIRING_COMPLETE = 0x36


class Status(IntEnum):
    """Error codes (vol 1 part F)."""

    SUCCESS = 0x00
    UNKNOWN_COMMAND = 0x01
    UNKNOWN_CONNECTION = 0x02
    PAGE_TIMEOUT = 0x04
    AUTHENTICATION_FAILURE = 0x05
    KEY_MISSING = 0x06
    CONNECTION_TIMEOUT = 0x08
    CONNECTION_LIMIT = 0x09
    CONNECTION_EXISTS = 0x0B
    COMMAND_DISALLOWED = 0x0C
    LIMITED_RESOURCES = 0x0D
    ACCEPT_TIMEOUT = 0x10
    LOCAL_HOST_TERMINATED = 0x16
    PAIRING_NOT_ALLOWED = 0x18


def to_wire(address: str) -> bytes:
    """The six bytes of an address."""
    return bytes.fromhex(address.replace(":", ""))[::-1]


def from_wire(raw: bytes) -> str:
    """The address in these six bytes."""
    return raw[::-1].hex(":").upper()


@dataclass(frozen=True)
class Command:
    """What the host wants."""

    op: int
    parameters: bytes


@dataclass(frozen=True)
class Acl:
    """Data of a link."""

    handle: int
    boundary: int
    """Packet boundary flag: 0 first, not to be flushed; 1 continued; 2 first."""
    data: bytes


_ACL = struct.Struct("<HH")


def parse(packet: bytes) -> Command | Acl:
    """A whole packet of the host; raises HciError."""
    if len(packet) >= 4 and packet[0] == Packet.COMMAND and len(packet) == 4 + packet[3]:
        return Command(packet[1] | packet[2] << 8, packet[4:])
    if len(packet) >= 5 and packet[0] == Packet.ACL:
        handle, size = _ACL.unpack_from(packet, 1)
        if len(packet) == 5 + size:
            return Acl(handle & 0xFFF, handle >> 12 & 3, packet[5:])
    raise HciError(f"no packet of a host: {packet[:16].hex()} ({len(packet)} bytes)")


def split(data: bytes) -> tuple[list[bytes], bytes]:
    """The whole packets at the beginning of a serial line's bytes, and what is left; raises HciError."""
    packets = []
    while data:
        if data[0] == Packet.COMMAND:
            size = 4 + data[3] if len(data) >= 4 else 0
        elif data[0] == Packet.ACL:
            size = 5 + (data[3] | data[4] << 8) if len(data) >= 5 else 0
        else:
            raise HciError(f"packet type {data[0]} from a host")
        if not size or len(data) < size:
            break
        packets.append(data[:size])
        data = data[size:]
    return packets, data


def event(code: int, body: bytes = b"") -> bytes:
    """An event packet."""
    return bytes((Packet.EVENT, code, len(body))) + body


def complete(op: int, result: bytes = b"\0") -> bytes:
    """Command Complete; the result begins with a status. One command may be sent at a time."""
    return event(Ev.COMMAND_COMPLETE, struct.pack("<BH", 1, op) + result)


def status(op: int, code: int = Status.SUCCESS) -> bytes:
    """Command Status: it was understood (or not), and its end will be an event."""
    return event(Ev.COMMAND_STATUS, struct.pack("<BBH", code, 1, op))


def acl(handle: int, boundary: int, data: bytes) -> bytes:
    """Data for the host; what began unflushable arrives as a plain beginning."""
    return bytes((Packet.ACL,)) + _ACL.pack(handle | (boundary or 2) << 12, len(data)) + data


def connected(code: int, handle: int, address: str) -> bytes:
    """Connection Complete of an ACL link, not encrypted."""
    return event(Ev.CONNECTION_COMPLETE, struct.pack("<BH", code, handle) + to_wire(address) + b"\x01\0")


def role_changed(peer: str, *, peripheral: bool) -> bytes:
    """Role Change: what this side is in the link with that one from now on."""
    return event(Ev.ROLE_CHANGE, b"\0" + to_wire(peer) + bytes((peripheral,)))


def disconnected(handle: int, reason: int) -> bytes:
    """Disconnection Complete."""
    return event(Ev.DISCONNECTION_COMPLETE, struct.pack("<BHB", Status.SUCCESS, handle, reason))


def completed(handle: int) -> bytes:
    """One packet of that link has left the controller: the host may send another one."""
    return event(Ev.COMPLETED_PACKETS, struct.pack("<BHH", 1, handle, 1))
