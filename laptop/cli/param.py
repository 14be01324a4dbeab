"""`swarm app param ... --real`: an app's parameters on every robot of the configuration, over ssh."""

import argparse
import shlex

from laptop.fleet.ssh import everyone, robot_command
from laptop.fleet.ssh.ssh import CURRENT, Host
from swarm.onboard import param

COMMAND = f"sudo -n {CURRENT}/bin/swarm app param"
"""The command `swarm` on a robot."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what a robot's command takes, and the way by ssh."""
    param.add_arguments(parser)
    robot_command.add_real(parser, "--fleet")
    everyone.add_way(parser, timeout_s=20)


def run(args: argparse.Namespace) -> int:
    """Show or set parameters. Return 1 where a robot does not answer, or refuses."""
    if not (robot_command.is_meant(args) or args.real):
        return param.run(args)
    wanted = param.settings_of(args)  # what is wrong is said here, not by each robot
    _, robots, ssh = everyone.recipients(args)
    param.check_robots(wanted, [host.robot for host in robots])

    async def job(host: Host, tell: everyone.ReportProgress) -> str:
        words = [word for word in args.settings if "." not in word.partition("=")[0]]
        # Last, as the last one is taken: a robot's own value goes before that of all.
        words += [word.partition(".")[2] for word in args.settings if word.startswith(f"{host.robot}.")]
        if args.settings and not words:
            return "nothing to change"
        await ssh.follow(host, f"{COMMAND} {shlex.join([args.app, *words])}", tell)
        return ""

    return everyone.run(args, robots, job)
