"""The I2C bus as the drivers see it, and the real one of a Raspberry Pi.

The same driver code meets the real bus, the simulated robot (services/sim) and the firmware in a simulator: each is an
`I2CBus`. A transfer that the other side did not acknowledge raises OSError, as the kernel does (121 EREMOTEIO, 110
ETIMEDOUT), on every kind of bus.
"""

from pathlib import Path
from typing import Any, Protocol

from swarm.errors import LocalError


class I2CBus(Protocol):
    """One I2C master. Every method is one transaction on the wire, ended by a STOP."""

    def write(self, address: int, data: bytes) -> None:
        """START, address+W, data, STOP."""

    def read(self, address: int, count: int) -> bytes:
        """START, address+R, `count` bytes, STOP."""

    def write_read(self, address: int, data: bytes, count: int) -> bytes:
        """START, address+W, data, repeated START, address+R, `count` bytes, STOP."""

    def close(self) -> None:
        """Give the bus back."""


class KernelBus:
    """An adapter of the kernel, /dev/i2c-N, through smbus2."""

    def __init__(self, number: int = 1) -> None:
        """Raises `LocalError` where smbus2 or the device is missing."""
        device = Path(f"/dev/i2c-{number}")
        try:
            import smbus2
        except ImportError:
            raise LocalError("the I2C bus needs smbus2: install the extra `balboa-swarm[robot]`") from None
        if not device.exists():
            raise LocalError(f"{device} is missing: switch I2C on (dtparam=i2c_arm=on in config.txt) and reboot")
        try:
            self._bus: Any = smbus2.SMBus(number)
        except OSError as error:
            raise LocalError(f"{device} cannot be opened: {error.strerror}; is this user in the group i2c?") from None
        self._message = smbus2.i2c_msg

    def write(self, address: int, data: bytes) -> None:
        """See `I2CBus`."""
        self._bus.i2c_rdwr(self._message.write(address, data))

    def read(self, address: int, count: int) -> bytes:
        """See `I2CBus`."""
        incoming = self._message.read(address, count)
        self._bus.i2c_rdwr(incoming)
        return bytes(incoming)

    def write_read(self, address: int, data: bytes, count: int) -> bytes:
        """See `I2CBus`."""
        incoming = self._message.read(address, count)
        self._bus.i2c_rdwr(self._message.write(address, data), incoming)
        return bytes(incoming)

    def close(self) -> None:
        """See `I2CBus`."""
        self._bus.close()
