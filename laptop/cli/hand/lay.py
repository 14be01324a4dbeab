"""`swarm hand lay ROBOT back|front`: take a robot of a running simulation and lay it down."""

import argparse
from pathlib import Path

from sim.control.send_action import do
from sim.core import actions
from swarm.process.simulations import runtime_of

HELP = "lay a simulated robot on its back or front"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`ROBOT back|front [--run-dir DIR]`."""
    parser.add_argument("robot", help="name of a simulated robot, e.g. r0")
    parser.add_argument("side", choices=actions.SIDES)
    parser.add_argument("--run-dir", type=Path, help="of the simulation, where it was started with one")


def run(args: argparse.Namespace) -> int:
    """Raises `LocalError` where there is no such simulation or robot."""
    do(runtime_of(args.run_dir, args.robot), actions.Lay(args.side))
    print(f"{args.robot}: laid on its {args.side}")
    return 0
