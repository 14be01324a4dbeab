"""`swarm app start|stop NAME [ROBOT...]`: another app beside those that run, on simulated robots or on real ones."""

import argparse

from laptop.fleet import apps
from laptop.fleet.ssh import everyone, robot_command
from laptop.fleet.ssh.ssh import Host
from laptop.fleet.units import unit
from sim.control import app_requests
from swarm.process.arguments import show
from swarm.process.simulations import robots, running


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `start|stop NAME [ROBOT...]`. The act is part of the command's name."""
    parser.add_argument("act", choices=app_requests.ACTS, help=argparse.SUPPRESS)
    parser.add_argument(
        "app", metavar="APP", help="a built-in app; on real robots also an app that swarm run has copied"
    )
    parser.add_argument("which", nargs="*", metavar="ROBOT", help="names of robots (default: all)")
    robot_command.add_simulation(parser)
    everyone.add_arguments(parser, timeout_s=60)


def run(args: argparse.Namespace) -> int:
    """Start or stop an app. Raises `LocalError` where there is no such simulation, robot or app."""
    if not robot_command.is_meant(args):
        run_dir = running(args.run_dir)
        named = [*args.which, *(args.robots or ())]
        done = app_requests.request_app(run_dir, args.act, args.app, named or list(robots(run_dir)))
        show(args, {"app": args.app, "act": args.act, "done": done}, [done])
        return 0
    everyone.named(args)
    _, hosts, ssh = everyone.recipients(args)

    async def job(host: Host, _: everyone.ReportProgress) -> str:
        return await apps.systemctl(ssh, host, args.act, [unit(args.app)])

    return everyone.run(args, hosts, job)
