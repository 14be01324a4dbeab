"""`swarm logs [SERVICE...]`: what the services of all robots have written to their journals."""

import argparse

from laptop.fleet import everyone
from laptop.fleet.everyone import ReportProgress
from laptop.fleet.ssh import Host
from laptop.fleet.units import unit
from swarm.errors import LocalError
from swarm.onboard.arguments import whole

HELP = "the logs of all robots, over ssh"

FOREVER_S = 1e9


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which services, and how much."""
    parser.add_argument("services", nargs="*", metavar="SERVICE", help="bus, mesh, balancer, dwm or an app; all")
    parser.add_argument("-f", "--follow", action="store_true", help="and what comes, until Ctrl-C")
    parser.add_argument("-n", "--lines", type=whole(0), default=20, help="of each robot (20)")
    everyone.add_arguments(parser, timeout_s=30)


def run(args: argparse.Namespace) -> int:
    """Lines as they come, each with its robot's name."""
    if args.follow and args.json:
        raise LocalError("--follow and --json do not go together: there is no end to report")
    _, robots, ssh = everyone.chosen(args)
    which = " ".join(f"--unit={name}" for name in map(unit, args.services)) or "--unit='swarm*'"
    command = f"journalctl --no-pager --output=short-iso --lines={args.lines} {which}"
    if args.follow:
        command, args.timeout = command + " --follow", FOREVER_S

    async def job(host: Host, tell: ReportProgress) -> str:
        return f"{await ssh.follow(host, command, tell)} lines"

    return everyone.run(args, robots, job)
