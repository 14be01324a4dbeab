"""`swarm drive ROBOT` on a laptop: a robot of a simulation, or a real one, which gets the keys over ssh."""

import argparse
import sys

from laptop.cli import halt
from laptop.fleet.ssh import remote_keys, robot_command
from laptop.fleet.ssh.ssh import Host, Ssh, hosts
from swarm.config import load
from swarm.errors import LocalError
from swarm.onboard.body import drive
from swarm.process.terminal import write_lines


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what a robot's command takes, and the way by ssh."""
    drive.add_arguments(parser)
    robot_command.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Drive. Return 1 where the robot was stopped or went silent."""
    if not robot_command.is_far(args):
        return drive.run(args)
    host, ssh = far(args)

    def line(text: str) -> None:
        show(text)
        if text == f"{host.robot}: {drive.STOP_WORD}":
            halt.stop_all(drive.REASON, args)

    return remote_keys.run(ssh, host, robot_command.words(host, ["drive"]), line)


def far(args: argparse.Namespace) -> tuple[Host, Ssh]:
    """Return the one real robot that is meant, and the way to it; raises `LocalError`."""
    if args.name and args.robots:
        raise LocalError("name the robot by --robots or as an argument, not by both")
    found = hosts(load(args.config, addressed=False), [args.name] if args.name else args.robots)
    if len(found) != 1:
        raise LocalError(f"which robot? there are {', '.join(host.robot for host in found)}")
    return found[0], Ssh(args.ssh_config)


def show(line: str) -> None:
    """Write a line of the robot at once."""
    write_lines([line])
    sys.stdout.flush()
