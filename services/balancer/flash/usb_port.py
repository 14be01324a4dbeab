"""The USB serial port of a Balboa's bootloader: finding it, getting a board to show it, and talking over it."""

import contextlib
import errno
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

from services.balancer.core.flashing.avr109 import BAUD, Conversation
from swarm.errors import LocalError, MissingPackageError, RemoteError

POLOLU = 0x1FFB
BOOTLOADER = (POLOLU, 0x0101)
"""USB vendor and product of Pololu's bootloader for the ATmega32U4; a sketch of the Arduino IDE has 1ffb:2300."""

SYSFS = Path("/sys/class/tty")
TOUCH_BAUD = 1200
"""Opened at this speed and closed, a sketch of the Arduino IDE starts the bootloader. Our firmware has no USB."""
_LOOK_S = 0.1


def ports(sysfs: Path = SYSFS) -> dict[str, tuple[int, int]]:
    """(Vendor, product) of each USB serial port, by its device file."""
    found = {}
    for tty in sorted(sysfs.glob("tty*")):
        # ttyACM0/device is the interface; the device that has the ids is above it.
        with contextlib.suppress(OSError, ValueError):
            device = (tty / "device").resolve(strict=True).parent
            found[f"/dev/{tty.name}"] = (
                int((device / "idVendor").read_text(), 16),
                int((device / "idProduct").read_text(), 16),
            )
    return found


def wait_for_bootloader(seconds: float, sysfs: Path = SYSFS, sleep: Callable[[float], None] = time.sleep) -> str:
    """Return the one bootloader's port; raises `RemoteError` where none comes, `LocalError` where there are several, or
    where this system does not list its ports as Linux does."""
    if not sysfs.is_dir():
        raise LocalError("looking for a bootloader needs Linux (on Windows: WSL): name its port with --port")
    for _ in range(max(1, round(seconds / _LOOK_S))):
        found = [port for port, ids in ports(sysfs).items() if ids == BOOTLOADER]
        if len(found) > 1:
            raise LocalError(f"several bootloaders wait, at {', '.join(found)}: name one with --port")
        if found:
            return found[0]
        sleep(_LOOK_S)
    raise RemoteError(
        f"no bootloader has come to a USB port within {seconds:g} s: is the Balboa's USB port connected here? "
        "Press its reset button twice within 0.7 s (the yellow LED breathes), and try again"
    )


def _pyserial() -> ModuleType:
    try:
        import serial
    except ImportError:
        raise MissingPackageError("a USB port", "pyserial", "lab", "robot") from None
    return serial


def touch(port: str) -> None:
    """Have a sketch of the Arduino IDE start the bootloader."""
    serial = _pyserial()
    with contextlib.suppress(serial.SerialException, OSError):  # it goes away while it is closed
        line = serial.Serial(port, TOUCH_BAUD)
        line.dtr = False
        line.close()


def converse(port: str, conversation: Conversation) -> str:
    """Carry out a conversation at a port; `RemoteError` where the other end is silent or says something wrong."""
    serial = _pyserial()
    try:
        line = serial.Serial(port, BAUD, exclusive=True)
    except (serial.SerialException, OSError) as error:
        hint = "; is this user in the group dialout?" if error.errno == errno.EACCES else ""
        raise LocalError(f"{port} cannot be opened: {error}{hint}") from None
    try:
        with contextlib.closing(line):
            line.reset_input_buffer()
            exchange = next(conversation)
            while True:
                line.timeout = exchange.patience_s
                line.write(exchange.request)
                answer = line.read(exchange.answer)
                if len(answer) < exchange.answer:
                    raise RemoteError(
                        f"{port}: the bootloader does not answer {exchange.request[:1]!r} (got {answer!r}); "
                        "press reset twice within 0.7 s, and flash again"
                    )
                try:
                    exchange = conversation.send(answer)
                except StopIteration as end:
                    return str(end.value)
    except (serial.SerialException, OSError) as error:
        raise RemoteError(f"{port} went away: {error}; press reset twice within 0.7 s, and flash again") from None
