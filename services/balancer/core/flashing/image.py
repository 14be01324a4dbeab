"""A firmware that may be flashed: what its mark says it is, and what it must be.

The firmware carries a mark (firmware/boot.cpp): which chip it was compiled for, which layout it speaks at the I2C bus
and its release. A file without one is not ours.
"""

from typing import NamedTuple

from services.balancer.core.devices import balboa
from services.balancer.core.flashing import intel_hex
from swarm.errors import LocalError

PAGE = 128
"""Bytes that an ATmega32U4 writes at once (datasheet table 28-11)."""
ROOM = 28672
"""Bytes below the bootloader (BOOTSZ of Pololu's fuses: 2048 words)."""
SIGNATURE = bytes((0x1E, 0x95, 0x87))
"""The signature of the ATmega32U4 (datasheet table 28-6)."""
CHIPS = {
    SIGNATURE: "ATmega32U4",
    b"\x1e\x95\x8a": "ATmega32U2",
    b"\x1e\x94\x88": "ATmega16U4",
    b"\x1e\x95\x0f": "ATmega328P",
    b"\x1e\x97\x82": "AT90USB1286",
    b"\x1e\x98\x01": "ATmega2560",
}

MARK = b"balboa-swarm firmware\0"


class Image(NamedTuple):
    """The image of a firmware."""

    data: bytes
    """The bytes from address 0 on, in whole pages."""
    layout: int
    """Version of what it offers at I2C (balboa.LAYOUT_VERSION)."""
    revision: int
    """Release of the firmware."""

    @property
    def pages(self) -> list[tuple[int, bytes]]:
        """(Address, data) of each page."""
        return [(at, self.data[at : at + PAGE]) for at in range(0, len(self.data), PAGE)]


def chip(signature: bytes) -> str:
    """Return a chip's name by its signature."""
    return CHIPS.get(signature, f"a chip with signature {signature.hex(' ')}")


def read(text: str) -> Image:
    """Read a firmware from Intel HEX. Raises `LocalError` where it is not one for this robot and this release."""
    data = intel_hex.parse(text, ROOM)
    at = data.find(MARK)
    if at < 0 or len(data) < at + len(MARK) + 5:
        raise LocalError("no firmware of Balboa Swarm: it does not have its mark")
    signature, (layout, revision) = data[at + len(MARK) :][:3], data[at + len(MARK) + 3 :][:2]
    if signature != SIGNATURE:
        raise LocalError(f"it was made for {chip(signature)}, a Balboa 32U4 has an {chip(SIGNATURE)}")
    if layout != balboa.LAYOUT_VERSION:
        raise LocalError(
            f"it has layout version {layout}, this release needs {balboa.LAYOUT_VERSION}: "
            "take the firmware of this release (make -C firmware)"
        )
    return Image(data + bytes((intel_hex.ERASED,)) * (-len(data) % PAGE), layout, revision)
