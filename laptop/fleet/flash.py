"""`swarm flash FIRMWARE.hex`: new firmware for the Balboas of all robots, or of one whose USB cable is plugged in here.

    swarm flash balboa.hex [--robots r0,r3]   over ssh; each robot's Pi is connected to its Balboa by a USB cable
    swarm flash balboa.hex --port PORT        the Balboa at this port of this computer (`auto`: wait for its bootloader)
    swarm flash - --here                      on a robot, as root: what the first form runs there

On a robot the balancer is stopped, the ATmega is told over I2C to start its bootloader (motors off), and afterwards
asked who it is. A board that does not obey, since its firmware is another one, needs two presses of its reset button.
"""

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from laptop.fleet import everyone
from laptop.fleet.everyone import ReportProgress
from laptop.fleet.ssh import Host, HostError, last_words
from services.balancer import atmega, usb_port
from services.balancer.core import avr109, image
from services.balancer.core.controller import BALANCING, LYING_DOWN, STANDING_UP
from services.balancer.core.image import Image
from services.balancer.i2c import I2CBus, KernelBus
from swarm.bus.zenoh_bus import Bus
from swarm.config import load, who_am_i
from swarm.errors import LocalError, PayloadError, RemoteError
from swarm.messages import BalancerState, read
from swarm.messages.keys import key
from swarm.process.paths import runtime_dir
from swarm.process.terminal import guard

UNIT = "swarm-balancer.service"
BY_COMMAND_S = 10.0
"""Until the bootloader of a board that was told to start it is at USB."""
BY_HAND_S = 60.0
"""Until somebody has pressed reset twice."""
START_S = 8.0
"""Until the new firmware answers: the bootloader leaves half a second after the end."""
STATE_S = 1.5
"""Until a balancer that runs has told its mode: it does 25 times a second."""
_STEP = 0.25
"""Share between two words of progress."""
_ON_ITS_FEET = (STANDING_UP, BALANCING, LYING_DOWN)

Say = Callable[[str], None]


def main() -> None:
    """Our own errors are one line; exit code 0 where the firmware runs everywhere it was to, 1 where a robot failed, 2
    where the command or the firmware is wrong."""
    guard()
    try:
        code = _main(_options())
    except LocalError as error:
        sys.stderr.write(f"swarm: {error}\n")
        code = 2
    except RemoteError as error:
        sys.stderr.write(f"swarm: {error}\n")
        code = 1
    except KeyboardInterrupt:
        code = 130
    sys.exit(code)


def _main(args: argparse.Namespace) -> int:
    text = _read(args.firmware)
    try:
        firmware = image.read(text)
    except LocalError as error:
        raise LocalError(f"{args.firmware}: {error}") from None
    if args.here:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # who has started us may go away in mid-flash
        here(firmware, _print, KernelBus, force=args.force)
        return 0
    if args.port:
        at_port(firmware, args.port, _print)
        return 0
    return _everywhere(args, text, firmware)


def at_port(firmware: Image, port: str, say: Say) -> None:
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
    firmware: Image,
    say: Say,
    open_bus: Callable[[], I2CBus],
    *,
    force: bool,
    wait: Callable[[float], str] = usb_port.wait_for_bootloader,
) -> None:
    """Flash this robot's board; raises `SwarmError`. The balancer runs again afterwards, however it ends."""
    if os.geteuid() != 0:
        raise LocalError("on a robot this needs root: sudo swarm flash ... --here")
    if not force and (mode := _mode()) in _ON_ITS_FEET:
        raise LocalError(
            f"the robot is {mode.replace('_', ' ')}, and would fall: lay it down first (set/mode lie), or --force"
        )
    _systemctl("stop")
    try:
        with contextlib.closing(open_bus()) as bus:
            before = atmega.versions(bus)
            say("no firmware answers" if before is None else f"revision {before[1]} before (layout {before[0]})")
            obeyed = atmega.enter_bootloader(bus)
            if not obeyed:
                say("it takes no command: press reset twice within 0.7 s")
            _flash(firmware, wait(BY_COMMAND_S if obeyed else BY_HAND_S), say)
            _check(bus, firmware)
    finally:
        _systemctl("start")


def _flash(firmware: Image, port: str, say: Say) -> None:
    told = 0.0

    def progress(share: float) -> None:
        nonlocal told
        if share - told >= _STEP:
            told = share
            say(f"{100 * share:.0f} %")

    say(f"flashing {len(firmware.data)} bytes at {port}")
    usb_port.converse(port, avr109.flash(firmware, progress))
    say(f"written and read back: revision {firmware.revision} (layout {firmware.layout})")


def _check(bus: I2CBus, firmware: Image) -> None:
    """Whether what was flashed answers over I2C."""
    end = time.monotonic() + START_S
    found = None
    while time.monotonic() < end:
        if (found := atmega.versions(bus)) == (firmware.layout, firmware.revision):
            return
        time.sleep(0.1)
    raise RemoteError(
        f"the flash is right, but over I2C {'nobody answers' if found is None else f'revision {found[1]} does'}: "
        "switch the robot's power off and on"
    )


def _mode() -> str:
    """What the balancer does; empty where none runs."""
    robot, found, heard = who_am_i(load()), "", threading.Event()

    def take(name: str, payload: bytes) -> None:
        nonlocal found
        with contextlib.suppress(PayloadError):
            if isinstance(message := read(name, payload), BalancerState):
                found = message.mode
                heard.set()

    with Bus.of(runtime_dir()) as bus:
        bus.subscribe([key(robot, "balancer", "state")], take)
        heard.wait(STATE_S)
    return found


def _systemctl(action: str) -> None:
    done = subprocess.run(["systemctl", action, UNIT], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise LocalError(f"systemctl {action} {UNIT}: {last_words(done.stderr) or done.returncode}")


def _everywhere(args: argparse.Namespace, text: str, firmware: Image) -> int:
    _, robots, ssh = everyone.chosen(args)

    async def job(host: Host, tell: ReportProgress) -> str:
        command = f"sudo -n env SWARM_ROBOT={host.robot} /opt/swarm/current/bin/swarm flash - --here"
        last = ""

        def line(words: str) -> None:
            nonlocal last
            last = words
            tell(words)

        done = await ssh.run(host, command + " --force" * args.force, feed=[text.encode()], on_line=line)
        if done.code != 0:
            raise HostError(last_words(done.err).removeprefix("swarm: ") or last or f"exit code {done.code}")
        return f"revision {firmware.revision} runs"

    return everyone.run(args, robots, job)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="swarm flash", description="New firmware for Balboas, over their USB cables.")
    parser.add_argument("firmware", metavar="FIRMWARE.hex", help="of `make -C firmware`; - is the input")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--port", help="of this computer, e.g. /dev/ttyACM0; auto: wait for a bootloader")
    where.add_argument("--here", action="store_true", help="this robot's own (as root)")
    parser.add_argument("--force", action="store_true", help="even where the robot stands: it falls")
    everyone.add_arguments(parser, timeout_s=120)
    return parser.parse_args()


def _read(name: str) -> str:
    try:
        data = sys.stdin.buffer.read() if name == "-" else Path(name).read_bytes()
    except OSError as error:
        raise LocalError(f"{name} cannot be read: {error.strerror}; make -C firmware makes one") from None
    return data.decode("ascii", "replace")


def _print(text: str) -> None:
    """Who listens may have gone away in mid-flash: it goes on."""
    with contextlib.suppress(OSError):
        sys.stdout.write(text + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
