"""`swarm flash [FIRMWARE.hex]` on a laptop: the Balboas of all robots over ssh, or one at a port of this computer.

Each robot's Pi is connected to its Balboa by a USB cable, and flashes it itself (`services.balancer.flash`).
"""

import argparse

from laptop.fleet.release.release import FIRMWARE
from laptop.fleet.ssh import everyone
from laptop.fleet.ssh.ssh import CURRENT, Host, HostError
from services.balancer.flash import flash

HELP = "write new firmware to the Balboas, over their USB cables"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what a robot's command takes, and the way by ssh."""
    flash.add_arguments(parser, optional=True)
    everyone.add_arguments(parser, timeout_s=120)


def run(args: argparse.Namespace) -> int:
    """Flash the robots. Return 0 where the firmware runs on all of them, 1 where a robot failed."""
    args.firmware = args.firmware or str(FIRMWARE)
    if args.here or args.port:
        return flash.run(args)
    data, read = flash.read_firmware(args.firmware)
    _, robots, ssh = everyone.recipients(args)

    async def job(host: Host, tell: everyone.ReportProgress) -> str:
        command = f"sudo -n env SWARM_ROBOT={host.robot} {CURRENT}/bin/swarm flash - --here"
        try:
            await ssh.follow(host, command + " --force" * args.force, tell, feed=[data])
        except HostError as error:
            raise HostError(str(error).removeprefix("swarm: ")) from None
        return f"revision {read.revision} runs"

    return everyone.run(args, robots, job)
