"""What a controller answers at all times, whatever its host has set."""

import struct

from lab.radio.core.hci import Op

DATA_SIZE, DATA_PACKETS = 1021, 8
"""Bytes of the largest packet of data and how many a controller keeps, for all links together."""

_FEATURE_BITS = {
    "3-slot packets": 0,
    "5-slot packets": 1,
    "encryption": 2,
    "role switch": 5,
    "RSSI with inquiry results": 30,
    "secure simple pairing": 51,
    "extended features": 63,
}
"""Of the link manager (vol 2 part C, 3.3); no LE."""
FEATURES = sum(1 << bit for bit in _FEATURE_BITS.values()).to_bytes(8, "little")

_COMMAND_BITS = {"write default link policy": 5 * 8 + 4, "read encryption key size": 20 * 8 + 4}
"""Commands a host asks for before it uses them (vol 4 part E, 6.27)."""
COMMANDS = sum(1 << bit for bit in _COMMAND_BITS.values()).to_bytes(64, "little")

VERSION = 9
"""Of the specification: 5.0."""
COMPANY = 0xFFFF
"""Of nobody."""
GENERAL_INQUIRY = b"\x33\x8b\x9e"
ENCRYPTION_KEY_SIZE = 16
RSSI = -56
"""dBm, of every robot found by an inquiry; a link's own figure is the medium's."""

ANSWERED = {
    **dict.fromkeys((0x080F, 0x0C01, 0x0C05, 0x0C16, 0x0C1E, 0x0C20, 0x0C22, 0x0C26, 0x0C31), b"\0"),
    **dict.fromkeys((0x0C33, 0x0C3A, 0x0C45, 0x0C52, 0x0C63, 0x0C6D, 0x0C7A), b"\0"),
    Op.READ_STORED_LINK_KEY: struct.pack("<BHH", 0, 0, 0),
    Op.DELETE_STORED_LINK_KEY: struct.pack("<BH", 0, 0),
    Op.READ_ACCEPT_TIMEOUT: struct.pack("<BH", 0, 0x1F40),
    Op.READ_VOICE: struct.pack("<BH", 0, 0x0060),
    Op.READ_IAC_COUNT: b"\0\x01",
    Op.READ_IACS: b"\0\x01" + GENERAL_INQUIRY,
    Op.READ_INQUIRY_POWER: b"\0\0",
    Op.READ_VERSION: struct.pack("<BBHBHH", 0, VERSION, 0, VERSION, COMPANY, 0),
    Op.READ_COMMANDS: b"\0" + COMMANDS,
    Op.READ_FEATURES: b"\0" + FEATURES,
    Op.READ_BUFFER_SIZE: struct.pack("<BHBHH", 0, DATA_SIZE, 64, DATA_PACKETS, 1),
}
"""Commands that have always the same result; the first are settings that make no difference here (event masks, filters,
scan and inquiry parameters)."""

OF_A_LINK = {0x080D: b"", 0x0811: b"", 0x0C28: b"", Op.READ_FAILED_CONTACTS: b"\0\0", Op.READ_QUALITY: b"\xff"}
"""Commands that begin with a link's handle, and so do their results: what follows."""

PAIRING = {
    *(Op.LINK_KEY_REPLY, Op.LINK_KEY_NEGATIVE_REPLY, Op.PIN_REPLY, Op.PIN_NEGATIVE_REPLY, Op.IO_CAPABILITY_REPLY),
    *(Op.IO_CAPABILITY_NEGATIVE_REPLY, Op.CONFIRM, Op.CONFIRM_NEGATIVE),
}
