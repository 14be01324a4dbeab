"""`swarm command 'COMMAND'`: run a shell command on every robot."""

import argparse

from laptop.fleet import everyone
from laptop.fleet.everyone import ReportProgress
from laptop.fleet.ssh import Host, HostError, last_words

HELP = "run a shell command on every robot, over ssh"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command, in one argument or several."""
    parser.add_argument("command", nargs="+", metavar="COMMAND", help="for the robots' shell, quoted")
    everyone.add_arguments(parser, timeout_s=60)


def run(args: argparse.Namespace) -> int:
    """Output comes as it is made, each line with its robot's name; 0 where it succeeded on all."""
    _, robots, ssh = everyone.chosen(args)
    command = " ".join(args.command)

    async def job(host: Host, tell: ReportProgress) -> str:
        last = ""

        def line(text: str) -> None:
            nonlocal last
            last = text
            tell(text)

        done = await ssh.run(host, command, on_line=line)
        if done.code != 0:
            raise HostError(f"exit code {done.code}: {last_words(done.err) or last_words(last)}")
        return ""

    return everyone.run(args, robots, job)
