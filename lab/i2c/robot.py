"""The simulated robot as the kernel's I2C adapter would reach it, with faults that are ordered: what goes over the wire
when, and what comes back."""

import errno
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from lab.i2c.ioctls import Message, failure
from sim.core.devices import NOBODY
from sim.devices.i2c import SimulatedBus
from swarm.errors import LocalError

ANY = 0
"""In place of an address: whichever device is spoken to."""


@dataclass
class Faults:
    """What is to go wrong: by address the number of messages that it still spoils."""

    nack: dict[int, int] = field(default_factory=dict)
    """Not acknowledged (121)."""
    short: dict[int, int] = field(default_factory=dict)
    """Ended too early (5)."""
    timeout: dict[int, int] = field(default_factory=dict)
    """SCL is held for longer than the adapter waits (110)."""
    corrupt: dict[int, int] = field(default_factory=dict)
    """What is read is not what was said."""
    mask: int = 0xFF
    """Bits that corruption turns over, in every byte."""
    hold_sda: bool = False
    """The next transfer ends in the middle of a byte: SDA is held (110) until nine clock pulses have come."""
    stuck: bool = False
    """SDA is held by something that no clock pulse frees (110)."""

    def order(self, wanted: dict[str, Any]) -> None:
        """Set fields, as JSON has them: addresses as text."""
        names = {each.name for each in fields(self)}
        if unknown := set(wanted) - names:
            raise LocalError(f"faults: {', '.join(sorted(unknown))} unknown; there are {', '.join(sorted(names))}")
        for name, value in wanted.items():
            counts = {int(address): count for address, count in value.items()} if isinstance(value, dict) else value
            setattr(self, name, counts)


class RobotAdapter:
    """See the module; an `ioctls.Adapter`."""

    def __init__(self, bus: SimulatedBus, clock: Callable[[], float], wait: Callable[[float], None]) -> None:
        """`wait` lets time pass, s."""
        self.faults = Faults()
        """Ordered by whoever tests."""
        self.timeout_s = 1.0
        """The kernel's own default."""
        self.transfers = self.failed = 0
        self._bus, self._clock, self._wait = bus, clock, wait

    def transfer(self, messages: list[Message]) -> bytes:
        """See `Adapter`. A transfer takes what its bytes take at 100 kHz, and a time-out takes its time."""
        self.transfers += 1
        began, before = self._clock(), self._bus.untimed()
        takes = 0.0
        try:
            return b"".join([self._message(message) for message in messages])
        except OSError as error:
            self.failed += 1
            takes = self.timeout_s if error.errno == errno.ETIMEDOUT else 0.0
            raise
        finally:
            left = began + max(takes, self._bus.untimed() - before) - self._clock()
            if left > 0.0:
                self._wait(left)

    def report(self) -> dict[str, Any]:
        """How the robot and its bus are now."""
        robot = self._bus.robot
        robot.atmega.advance(self._clock())
        return {
            "tilt": robot.body.tilt,
            "held": robot.body.held,
            "motors": robot.atmega.motors,
            "sda_held": robot.sda_held,
            "transfers": self.transfers,
            "failed": self.failed,
            "timeout_s": self.timeout_s,
            "faults": asdict(self.faults),
        }

    def _message(self, message: Message) -> bytes:
        faults, address = self.faults, message.address
        if faults.hold_sda or faults.stuck or faults.timeout or faults.nack or faults.short:
            self._fail(faults, address)
        if address == NOBODY:
            self._bus.recover()  # its clock pulses free SDA
            raise failure(errno.EREMOTEIO)
        if not message.read:
            if message.write:
                self._bus.write(address, message.write)
            elif address not in self._bus.robot.devices:  # a bare address, as i2cdetect sends it
                raise failure(errno.EREMOTEIO)
            return b""
        data = self._bus.read(address, message.read)
        if faults.corrupt and _spoils(faults.corrupt, address):
            return bytes(byte ^ faults.mask for byte in data)
        return data

    def _fail(self, faults: Faults, address: int) -> None:
        """As it was ordered for a message to that address, if it was."""
        if faults.hold_sda:
            faults.hold_sda, self._bus.robot.sda_held = False, True
        if faults.stuck or _spoils(faults.timeout, address):
            raise failure(errno.ETIMEDOUT)
        if _spoils(faults.nack, address):
            raise failure(errno.EREMOTEIO)
        if _spoils(faults.short, address):
            raise failure(errno.EIO)


def _spoils(counts: dict[int, int], address: int) -> bool:
    for key in (address, ANY):
        if counts.get(key, 0):
            counts[key] -= 1
            return True
    return False
