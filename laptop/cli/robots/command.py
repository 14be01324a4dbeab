"""`swarm command 'COMMAND'`: run a shell command on every robot."""

import argparse

from laptop.fleet.ssh import everyone
from laptop.fleet.ssh.ssh import CommandError, Host, HostError
from swarm.errors import LocalError

HELP = "run a shell command on every robot, over ssh"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command, which is one argument or several, and the way by ssh."""
    parser.usage = "swarm command [OPTION ...] 'COMMAND'   (with its options in quotes: swarm command 'ls -l')"
    parser.add_argument("command", nargs="+", metavar="COMMAND", help="command for the robots' shell, in quotes")
    everyone.add_arguments(parser, timeout_s=60)


def run(args: argparse.Namespace) -> int:
    """Print the output as it is made, each line with its robot's name. Return 0 where the command succeeded on all."""
    command = " ".join(args.command)
    if not command.strip():
        raise LocalError(
            "there is no command in the quotes: name one for the robots' shell, as in swarm command 'ls -l'"
        )
    _, robots, ssh = everyone.recipients(args)

    async def job(host: Host, tell: everyone.ReportProgress) -> str:
        try:
            await ssh.follow(host, command, tell)
        except CommandError as error:
            raise HostError(f"exit code {error.code}: {error}") from None
        return ""

    return everyone.run(args, robots, job)
