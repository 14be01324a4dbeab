"""`swarm flash FIRMWARE.hex`: new firmware for a Balboa, over its USB cable.

    swarm flash balboa.hex --port PORT        the Balboa at this port of this computer (`auto`: wait for its bootloader)
    swarm flash - --here                      on a robot, as root: its own Balboa

On a robot the balancer is stopped, the ATmega is told over I2C to start its bootloader (motors off), and afterwards
asked who it is. A board that does not obey, since its firmware is another one, needs two presses of its reset button.
"""

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from services.balancer.core.control.controller import ON_ITS_FEET
from services.balancer.core.devices import balboa
from services.balancer.core.flashing import avr109, image
from services.balancer.flash import usb_port
from services.balancer.i2c import I2CBus, KernelBus
from swarm.config import load, who_am_i
from swarm.errors import LocalError, RemoteError
from swarm.messages import BalancerState
from swarm.onboard.buses.ask import newest
from swarm.process.paths import runtime_dir

UNIT = "swarm-balancer.service"
BY_COMMAND_S = 10.0
"""Seconds until the bootloader appears on USB after the command that starts it."""
BY_HAND_S = 60.0
"""Seconds to wait for a person to press reset twice."""
START_S = 8.0
"""Seconds until the new firmware answers: the bootloader ends half a second after the transfer."""
STATE_S = 1.5
"""Seconds until a running balancer has published its mode, which it does 25 times a second."""
_STEP = 0.25
"""Share of the work between two reports of progress."""

Say = Callable[[str], None]


def add_arguments(parser: argparse.ArgumentParser, *, optional: bool = False) -> None:
    """Declare the firmware, and which Balboa gets it; `optional`: the caller has one where none is named."""
    made = "; default: that of this release" if optional else ""
    text = f"of `make -C firmware`; - is the input{made}"
    parser.add_argument("firmware", nargs="?" if optional else None, metavar="FIRMWARE.hex", help=text)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--port", help="serial port of this computer, e.g. /dev/ttyACM0; auto: wait for a bootloader")
    where.add_argument("--here", action="store_true", help="flash this robot's own board (as root)")
    parser.add_argument("--force", action="store_true", help="flash even while the robot stands: it falls")


def run(args: argparse.Namespace) -> int:
    """0 where the firmware runs, 1 where the board failed; raises `LocalError` where command or firmware are wrong."""
    firmware = read_firmware(args.firmware)[1]
    try:
        if args.port:
            at_port(firmware, args.port, _print)
        else:
            signal.signal(signal.SIGHUP, signal.SIG_IGN)  # who has started us may go away in mid-flash
            here(firmware, _print, KernelBus, force=args.force)
    except RemoteError as error:
        sys.stderr.write(f"swarm: {error}\n")
        return 1
    return 0


def read_firmware(name: str) -> tuple[bytes, image.Image]:
    """Return a file's bytes, and the firmware in it; raises `LocalError`."""
    try:
        data = sys.stdin.buffer.read() if name == "-" else Path(name).read_bytes()
        return data, image.read(data.decode("ascii", "replace"))
    except OSError as error:
        raise LocalError(f"{name} cannot be read: {error.strerror}; make -C firmware makes one") from None
    except LocalError as error:
        raise LocalError(f"{name}: {error}") from None


def at_port(firmware: image.Image, port: str, say: Say) -> None:
    """Flash the board at a port of this computer; raises `SwarmError`."""
    if port == "auto":
        say("press reset twice within 0.7 s")
        port = usb_port.wait_for_bootloader(BY_HAND_S)
    elif usb_port.ports().get(port, usb_port.BOOTLOADER) != usb_port.BOOTLOADER:
        say(f"{port} is no bootloader: starting it")
        usb_port.touch(port)
        port = usb_port.wait_for_bootloader(BY_COMMAND_S)
    _flash(firmware, port, say)


def here(
    firmware: image.Image,
    say: Say,
    open_bus: Callable[[], I2CBus],
    *,
    force: bool,
    wait: Callable[[float], str] = usb_port.wait_for_bootloader,
) -> None:
    """Flash this robot's board; raises `SwarmError`. The balancer runs again afterwards, however it ends."""
    if os.geteuid() != 0:
        raise LocalError("on a robot this needs root: sudo swarm flash ... --here")
    if not force and (mode := _mode()) in ON_ITS_FEET:
        raise LocalError(
            f"the robot is {mode.replace('_', ' ')}, and would fall: lay it down first (swarm balance lie), or --force"
        )
    _systemctl("stop")
    try:
        with contextlib.closing(open_bus()) as bus:
            before = versions(bus)
            say("no firmware answers" if before is None else f"revision {before[1]} before (layout {before[0]})")
            obeyed = enter_bootloader(bus)
            if not obeyed:
                say("it takes no command: press reset twice within 0.7 s")
            _flash(firmware, wait(BY_COMMAND_S if obeyed else BY_HAND_S), say)
            _check(bus, firmware)
    finally:
        _systemctl("start")


def _flash(firmware: image.Image, port: str, say: Say) -> None:
    told = 0.0

    def progress(share: float) -> None:
        nonlocal told
        if share - told >= _STEP:
            told = share
            say(f"{100 * share:.0f} %")

    say(f"flashing {len(firmware.data)} bytes at {port}")
    usb_port.converse(port, avr109.flash(firmware, progress))
    say(f"written and read back: revision {firmware.revision} (layout {firmware.layout})")


def _check(bus: I2CBus, firmware: image.Image) -> None:
    """Check that what was flashed answers over I2C."""
    end = time.monotonic() + START_S
    found = None
    while time.monotonic() < end:
        if (found := versions(bus)) == (firmware.layout, firmware.revision):
            return
        time.sleep(0.1)
    raise RemoteError(
        f"the flash is right, but over I2C {'nobody answers' if found is None else f'revision {found[1]} does'}: "
        "switch the robot's power off and on"
    )


def _mode() -> str:
    """Return the balancer's mode; empty where none runs."""
    state = newest(runtime_dir(), who_am_i(load()), BalancerState, "balancer", "state", STATE_S)
    return "" if state is None else state.mode


def _systemctl(action: str) -> None:
    done = subprocess.run(["systemctl", action, UNIT], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise LocalError(f"systemctl {action} {UNIT}: {done.stderr.strip() or done.returncode}")


def _print(text: str) -> None:
    """Print a line. The flash goes on where the reader has gone away."""
    with contextlib.suppress(OSError):
        sys.stdout.write(text + "\n")
        sys.stdout.flush()


def versions(bus: I2CBus) -> tuple[int, int] | None:
    """Layout and revision of its firmware; None where nobody answers."""
    try:
        bus.pause(balboa.PAUSE_S)
        bus.write(balboa.ADDRESS, bytes((balboa.VERSION,)))
        bus.pause(balboa.PAUSE_S)
        data = bus.read(balboa.ADDRESS, balboa.REVISION + 1)
    except OSError:
        return None
    return data[balboa.VERSION], data[balboa.REVISION]


def enter_bootloader(bus: I2CBus) -> bool:
    """Motors off, and into the bootloader; False where it does not take the command: nobody answers, or no firmware
    of ours."""
    try:
        bus.pause(balboa.PAUSE_S)
        bus.write(balboa.ADDRESS, bytes((balboa.MOTORS,)) + balboa.encode_motors(0.0, 0.0))
        bus.pause(balboa.PAUSE_S)
        bus.write(balboa.ADDRESS, bytes((balboa.COMMAND,)) + balboa.BOOTLOADER_COMMAND.to_bytes(2, "little"))
    except OSError:
        return False
    return True
