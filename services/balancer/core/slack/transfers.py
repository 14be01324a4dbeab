"""A transfer on the I2C bus, the unit of slack tasks."""

from typing import Protocol

from services.balancer.core.devices import balboa
from services.balancer.core.slack.wire_time import Room, Transfer


class SlackTask(Protocol):
    """Something done in the slack, one transfer after the other. It decides; who runs it does the transfers."""

    def next(self, now: float, room: Room) -> Transfer | None:
        """Return the next transfer, None where none is due. It is called again until `take` or `fail`.

        A task that can makes its transfer as short as `room` has it. One that cannot returns the shortest that it has.
        """

    def take(self, data: bytes, now: float) -> None:
        """The transfer succeeded; `data` is what was read. Raises `RemoteError` where that makes no sense."""

    def fail(self, error: OSError, now: float) -> None:
        """Note that the transfer failed."""


def read(offset: int, count: int) -> Transfer:
    """Read from the ATmega's buffer."""
    return Transfer(balboa.ADDRESS, bytes((offset,)), count)


def write(offset: int, data: bytes) -> Transfer:
    """Write to the ATmega's buffer."""
    return Transfer(balboa.ADDRESS, bytes((offset,)) + data)


def piece(offset: int, end: int, room: Room) -> Transfer:
    """Read from `offset` up to `end`, or as far as there is room: a byte at least."""
    return read(offset, max(1, min(end - offset, room.read)))
