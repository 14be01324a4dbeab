"""`swarm hand press ROBOT BUTTON`: press a button of a robot in a running simulation."""

import argparse
from pathlib import Path

from sim.control.send_action import do
from sim.core import actions
from swarm.process.simulations import runtime_of

HELP = "press a button of a simulated robot"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`ROBOT BUTTON [--hold S] [--run-dir DIR]`."""
    parser.add_argument("robot", help="name of a simulated robot, e.g. r0")
    parser.add_argument("button", choices=actions.BUTTONS)
    parser.add_argument("--hold", type=float, default=0.2, metavar="S", help="seconds until it is let go (0.2)")
    parser.add_argument("--run-dir", type=Path, help="of the simulation, where it was started with one")


def run(args: argparse.Namespace) -> int:
    """Raises `LocalError` where there is no such simulation or robot."""
    do(runtime_of(args.run_dir, args.robot), actions.Press(args.button, args.hold))
    print(f"{args.robot}: button {args.button} held for {args.hold:g} s")
    return 0
