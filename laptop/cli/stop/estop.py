"""`swarm estop [REASON]`: every robot switches its motors off, and stays so until `swarm arm`."""

import argparse

from laptop.cli.stop import halt

HELP = "stop every robot, and say who has obeyed"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`[REASON] [--timeout S] [--robot NAME] [--run-dir DIR] [--json]`."""
    parser.add_argument("reason", nargs="?", default="swarm estop", help="what the robots' logs and faults will say")
    halt.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Code 1 where a robot that can be reached has not confirmed in time."""
    return halt.run(args, stop=True, reason=args.reason)
