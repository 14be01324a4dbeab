"""`swarm hand push ROBOT`: push a robot in a running simulation."""

import argparse
from pathlib import Path

from sim.control.send_action import do
from sim.core import actions
from swarm.process.simulations import runtime_of

HELP = "push a simulated robot"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`ROBOT [--impulse Ns] [--run-dir DIR]`."""
    parser.add_argument("robot", help="name of a simulated robot, e.g. r0")
    parser.add_argument(
        "--impulse",
        type=float,
        default=0.1,
        metavar="NS",
        help="N s, negative from the front (0.1; 0.5 is too much)",
    )
    parser.add_argument("--run-dir", type=Path, help="of the simulation, where it was started with one")


def run(args: argparse.Namespace) -> int:
    """Raises `LocalError` where there is no such simulation or robot."""
    do(runtime_of(args.run_dir, args.robot), actions.Push(args.impulse))
    print(f"{args.robot}: pushed with {args.impulse:g} N s")
    return 0
