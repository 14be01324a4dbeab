"""`swarm balance stand|rest|lie|zero` on a laptop: robots of a simulation, or real ones by their own command."""

import argparse
from typing import Any

from laptop.fleet.ssh import everyone, robot_command
from laptop.fleet.ssh.ssh import Host, HostError, last_words
from swarm.errors import PayloadError
from swarm.messages.json_input import read_json
from swarm.onboard.body import balance

SLACK_S = 15.0
"""Seconds for the connection and a robot that is slow to start Python."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what a robot's command takes, and the way by ssh."""
    balance.add_arguments(parser)
    robot_command.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Return 1 where a robot refuses, does not answer or cannot be reached."""
    if not robot_command.is_far(args):
        return balance.run(args)
    _, robots, ssh = everyone.recipients(args)
    there, args.timeout = str(args.timeout), args.timeout + SLACK_S

    async def job(host: Host, _: everyone.ReportProgress) -> str:
        command = robot_command.words(host, ["balance", args.mode, "--json", "--timeout", there])
        done = await ssh.run(host, command)
        row = _row(done.out, host.robot)
        if not row:
            raise HostError(last_words(done.err).removeprefix("swarm: ") or f"no answer (exit code {done.code})")
        if not row.get("ok"):
            raise HostError(str(row.get("text")))
        return str(row.get("text"))

    return everyone.run(args, robots, job)


def _row(text: str, robot: str) -> dict[str, Any]:
    """Return what a robot's own command says of it; empty where it printed something else."""
    try:
        return dict(read_json(text)["robots"][robot])
    except (PayloadError, LookupError, TypeError, ValueError):
        return {}
