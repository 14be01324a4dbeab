"""The I2C bus as the drivers see it, and the real one of a Raspberry Pi.

The same driver code meets the real bus, the simulated robot (sim) and the firmware in a simulator: each is an
`I2CBus`. A transfer that the other side did not acknowledge raises OSError, as the kernel does (121 EREMOTEIO, 110
ETIMEDOUT, 5 EIO for one that ended too early), on every kind of bus.
"""

import contextlib
import fcntl
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from swarm.errors import LocalError, MissingPackageError
from swarm.process.locks import take_lock

NOBODY = 0x7F
"""An address that no device has (reserved by the I2C specification, UM10204 table 4). Read, it is a byte of ones: nine
clock pulses during which the master leaves SDA alone."""

TIMEOUT_10MS = 2
"""After 20 ms the kernel gives a transfer up. Its own default is a second, five times as long as the ATmega's watchdog
waits; the longest transfer that we make takes 4 ms."""

PATIENCE_S = 10.0
"""Seconds to wait for the device at the start: on a boot the balancer may be up before udev has made the device its
own."""
RETRY_S = 0.2

_I2C_TIMEOUT = 0x0702  # linux/i2c-dev.h, in units of 10 ms

_log = logging.getLogger("balancer")


class NoDeviceError(LocalError):
    """The adapter is missing, or this process may not use it."""


class BusInUseError(LocalError):
    """Another process has the adapter."""


class I2CBus(Protocol):
    """One I2C master. Every method is one transaction on the wire, ended by a STOP."""

    def write(self, address: int, data: bytes) -> None:
        """START, address+W, data, STOP."""

    def read(self, address: int, count: int) -> bytes:
        """START, address+R, `count` bytes, STOP."""

    def write_read(self, address: int, data: bytes, count: int) -> bytes:
        """START, address+W, data, repeated START, address+R, `count` bytes, STOP."""

    def recover(self) -> None:
        """Free the bus after a failed transfer from a device that holds SDA because it missed a clock pulse. This is
        quick (0.2 ms), harmless on a free bus, and silent where it does not help."""

    def pause(self, seconds: float) -> None:
        """Leave the devices alone for so long."""

    def untimed(self) -> float:
        """Return the seconds that transfers and pauses have counted instead of taking them: a simulated bus; 0 on a
        real one."""

    def close(self) -> None:
        """Give the bus back."""


class KernelBus:
    """An adapter of the kernel, /dev/i2c-N, through smbus2.

    What can be done about a stuck bus from here (kernel: drivers/i2c/busses/i2c-bcm2835.c): the driver has no bus
    recovery of its own. It gives a transfer up after the adapter's time-out, which may be set, and begins the next one
    without a look at the lines. So a byte read from nobody clocks out whatever a slave still wants to say, and its
    NACK and STOP end it. The ATmega lets go by itself (30 ms, firmware/twi.cpp). Opening the device again does nothing
    to the lines; binding the driver anew needs root and a closed device, and moves no line either.

    One process at a time has the adapter, by a lock of its device: a second master would move the ATmega's index
    between the first one's write and read. The kernel frees the lock of a process that has crashed.
    """

    def __init__(self, number: int = 1) -> None:
        """Raises `MissingPackageError` where smbus2 is missing, `NoDeviceError` where the device is, and
        `BusInUseError` while another process has it."""
        device = Path(f"/dev/i2c-{number}")
        try:
            import smbus2
        except ImportError:
            raise MissingPackageError("the I2C bus", "smbus2", "robot") from None
        if not device.exists():
            raise NoDeviceError(f"{device} is missing: switch I2C on (dtparam=i2c_arm=on in config.txt) and reboot")
        try:
            self._bus: Any = smbus2.SMBus(number)
        except OSError as error:
            raise NoDeviceError(
                f"{device} cannot be opened: {error.strerror}; is this user in the group i2c?"
            ) from None
        device_fd: Any = self._bus.fd
        try:
            take_lock(device_fd)
        except BlockingIOError:
            self._bus.close()
            raise BusInUseError(
                f"{device} is in use by another process (the balancer, swarm flash or swarm measure i2c): "
                "wait for its end"
            ) from None
        fcntl.ioctl(device_fd, _I2C_TIMEOUT, TIMEOUT_10MS)
        self._message = smbus2.i2c_msg

    def write(self, address: int, data: bytes) -> None:
        self._bus.i2c_rdwr(self._message.write(address, data))

    def read(self, address: int, count: int) -> bytes:
        incoming = self._message.read(address, count)
        self._bus.i2c_rdwr(incoming)
        return bytes(incoming)

    def write_read(self, address: int, data: bytes, count: int) -> bytes:
        incoming = self._message.read(address, count)
        self._bus.i2c_rdwr(self._message.write(address, data), incoming)
        return bytes(incoming)

    def recover(self) -> None:
        with contextlib.suppress(OSError):  # nobody acknowledges
            self._bus.i2c_rdwr(self._message.read(NOBODY, 1))

    def pause(self, seconds: float) -> None:
        time.sleep(seconds)

    def untimed(self) -> float:
        return 0.0

    def close(self) -> None:
        self._bus.close()


def open_patiently(wait: Callable[[float], None], number: int = 1) -> KernelBus:
    """Return the adapter, as soon as it is there and ours; `NoDeviceError` where it is not within `PATIENCE_S`.

    Services start while udev still works through the devices of the boot, and a wrong configuration (exit code 2),
    which a missing bus is, is left for a person. A process that has the adapter gives it back, so that is waited for
    without a limit.
    """
    missing = in_use = 0
    while True:
        try:
            return KernelBus(number)
        except NoDeviceError:
            missing += 1
            if missing > round(PATIENCE_S / RETRY_S):
                raise
        except BusInUseError as error:
            in_use += 1
            if in_use == 1:
                _log.warning("the balancer waits for the bus: %s", error)
        wait(RETRY_S)
