"""The firmware's layout as Python finds it in firmware/layout.h, which is written to be read by a machine."""

import re
import struct
from pathlib import Path
from typing import NamedTuple

FIRMWARE = Path(__file__).parents[2] / "firmware"


class Field(NamedTuple):
    offset: int
    size: int
    writer: str


_TEXT = (FIRMWARE / "layout.h").read_text()

FIELDS = {
    name: Field(int(offset), int(size), writer)
    for name, offset, size, writer in re.findall(
        r"^\s+FIELD\((\w+), (\d+), (\d+), (firmware|pi)\)", _TEXT, re.MULTILINE
    )
}
CONSTANTS = {
    name: int(value, 0) for name, value in re.findall(r"constexpr u?int\d+_t (\w+) = (0x[0-9A-Fa-f]+|\d+);", _TEXT)
}


def _enum(name: str) -> dict[str, int]:
    body = re.search(rf"enum (?:class )?{name} : uint8_t {{(.*?)}};", _TEXT, re.DOTALL)
    assert body
    return {member: int(value, 0) for member, value in re.findall(r"(\w+) = (0x[0-9A-Fa-f]+|\d+),", body[1])}


RESET_CAUSE = _enum("ResetCause")
UWB_STATE = _enum("UwbState")
MAILBOX_STATE = _enum("MailboxState")

UWB_HEAD = struct.Struct("<HHB")
UWB_TAIL = struct.Struct("<H")
