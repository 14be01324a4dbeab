"""`swarm services start|stop|restart`: systemd units of all robots."""

import argparse

from laptop.fleet import apps, everyone
from laptop.fleet.everyone import ReportProgress
from laptop.fleet.ssh import Host
from laptop.fleet.units import units


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what is to be done, and to which services."""
    parser.add_argument("action", choices=("start", "stop", "restart"), help=argparse.SUPPRESS)
    parser.add_argument(
        "services", nargs="*", metavar="SERVICE", help="bus, mesh, balancer, dwm or an app (default: all services)"
    )
    everyone.add_arguments(parser, timeout_s=60)


def run(args: argparse.Namespace) -> int:
    """Return 0 where it succeeded on every robot."""
    names = units(args.services)
    _, robots, ssh = everyone.chosen(args)

    async def job(host: Host, tell: ReportProgress) -> str:
        return await apps.systemctl(ssh, host, args.action, names)

    return everyone.run(args, robots, job)
