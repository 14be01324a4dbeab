"""Flashing by AVR109 as Pololu's bootloader (Caterina) speaks it: what is said, and what must come back.

Source: Atmel application note AVR109; Caterina.c of SparkFun and Pololu. Rules of that bootloader:

- One command for each USB packet: what follows a command in the same packet is thrown away, so nothing is sent before
  the answer to what went before is there.
- It leaves for the program after 8 s without a block command, but only while the first word of the flash is not erased.
  So all is erased first, and the first page is written last, when the others were read back: a transfer that is cut off
  at any moment leaves a bootloader that waits, and never half a firmware that runs. (avrdude begins with the first
  page.)
"""

from collections.abc import Callable, Generator
from typing import NamedTuple

from services.balancer.core.flashing.image import PAGE, SIGNATURE, Image, chip
from services.balancer.core.flashing.intel_hex import ERASED
from swarm.errors import RemoteError

BAUD = 57600
"""The baud rate of the port, which USB ignores. It must not be 1200, which starts the bootloader."""

ANSWER_S = 2.0
ERASE_S = 10.0
"""Seconds that erasing takes: 224 pages at 4.5 ms, twice, are 2 s."""

_DONE = b"\r"


class BootloaderExchange(NamedTuple):
    """The bytes to send, how many bytes must come back, and within how many seconds."""

    request: bytes
    answer: int
    patience_s: float = ANSWER_S


Conversation = Generator[BootloaderExchange, bytes, str]
"""Yields what is to be exchanged, is sent the answer, and returns the bootloader's own name."""


def flash(image: Image, progress: Callable[[float], None]) -> Conversation:
    """Write and read back an image; `progress` is told which share is done. Raises `RemoteError`: then the bootloader
    still runs, and it can be done again."""
    name = (yield BootloaderExchange(b"S", 7)).decode("ascii", "replace")
    if not name.isprintable():
        raise RemoteError(f"no bootloader answers, but {name!r}")
    signature = (yield BootloaderExchange(b"s", 3))[::-1]
    if signature != SIGNATURE:
        raise RemoteError(f"the bootloader is of {chip(signature)}, a Balboa 32U4 has an {chip(SIGNATURE)}")
    if (size := (yield BootloaderExchange(b"b", 3))) != b"Y" + PAGE.to_bytes(2):
        raise RemoteError(f"the bootloader takes no blocks of {PAGE} bytes (it says {size.hex(' ')})")
    yield from _confirmed(b"P", "programming mode")
    yield from _confirmed(b"e", "erasing", ERASE_S)
    (first, *others) = image.pages
    steps, done = 2 * len(image.pages), 0
    for pages in (others, [first]):
        for address, data in pages:
            if any(byte != ERASED for byte in data):
                yield from _write(address, data)
            progress((done := done + 1) / steps)
        for address, data in pages:
            if not (yield from _is(address, data)):
                yield from _write(0, bytes((ERASED,)) * PAGE)  # it shall not be started
                raise RemoteError(f"the flash holds something else at {address:#06x} than was written: flash again")
            progress((done := done + 1) / steps)
    yield from _confirmed(b"L", "leaving programming mode")
    yield from _confirmed(b"E", "starting the firmware")
    return name


def _confirmed(request: bytes, what: str, patience_s: float = ANSWER_S) -> Generator[BootloaderExchange, bytes, None]:
    answer = yield BootloaderExchange(request, 1, patience_s)
    if answer != _DONE:
        raise RemoteError(f"the bootloader refuses: {what} ({answer!r})")


def _at(address: int) -> Generator[BootloaderExchange, bytes, None]:
    yield from _confirmed(b"A" + (address // 2).to_bytes(2), f"address {address:#06x}")  # it counts words


def _write(address: int, data: bytes) -> Generator[BootloaderExchange, bytes, None]:
    yield from _at(address)
    yield from _confirmed(b"B" + len(data).to_bytes(2) + b"F" + data, f"writing at {address:#06x}")


def _is(address: int, data: bytes) -> Generator[BootloaderExchange, bytes, bool]:
    yield from _at(address)
    return (yield BootloaderExchange(b"g" + len(data).to_bytes(2) + b"F", len(data))) == data
