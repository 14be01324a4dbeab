"""One transfer on the I2C bus, and how long it takes: what slack tasks are made of.

At 100 kHz a byte and its acknowledge take 90 us. The ATmega holds SCL for a while with each byte, as the bug of the
Pi's I2C block makes necessary (firmware/twi.cpp).
"""

from typing import NamedTuple, Protocol

from services.balancer.core import balboa

BIT_S = 10e-6
"""At 100 kHz."""
BITS_PER_BYTE = 9
"""Eight and the acknowledge."""
BITS_PER_TRANSFER = 2
"""START and STOP (or repeated START) take about a bit each."""
HOLD_S = 25e-6
"""By which the ATmega lengthens each byte: between the 11 and 39 us seen in the simulator (firmware/README.md)."""

LONGEST = 32
"""Bytes of a transfer outside of the control step, index or control byte included: anything larger goes in slices."""


class Transfer(NamedTuple):
    """`data` is written; where `reads` is not 0, STOP, a pause, and that many bytes are read."""

    address: int
    data: bytes
    reads: int = 0


def duration(transfer: Transfer) -> float:
    """What it takes at most, s: on the wire, and the pauses before and between writing and reading."""
    parts = 2 if transfer.reads else 1
    size = parts + len(transfer.data) + transfer.reads
    wire = (BITS_PER_TRANSFER * parts + BITS_PER_BYTE * size) * BIT_S
    return wire + balboa.PAUSE_S * parts + HOLD_S * size if transfer.address == balboa.ADDRESS else wire


class SlackTask(Protocol):
    """Something done in the slack, one transfer after the other. It decides; who runs it does the transfers."""

    def next(self, now: float) -> Transfer | None:
        """What to do next, None where nothing is to be done now. Asked again until `take` or `fail`."""

    def take(self, data: bytes, now: float) -> None:
        """The transfer succeeded; `data` is what was read. Raises `RemoteError` where that makes no sense."""

    def fail(self, error: OSError, now: float) -> None:
        """The transfer failed."""


def read(offset: int, count: int) -> Transfer:
    """Read from the ATmega's buffer."""
    return Transfer(balboa.ADDRESS, bytes((offset,)), count)


def write(offset: int, data: bytes) -> Transfer:
    """Write to the ATmega's buffer."""
    return Transfer(balboa.ADDRESS, bytes((offset,)) + data)
