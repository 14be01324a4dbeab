"""`swarm arm`: take every stop back. Nothing moves by that: balancers wait for a command."""

import argparse

from laptop.cli.stop import halt

HELP = "take every stop back, and say who has heard it"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`[--timeout S] [--robot NAME] [--run-dir DIR] [--json]`."""
    halt.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Code 1 where a robot that can be reached has not confirmed in time."""
    return halt.run(args, stop=False, reason="")
