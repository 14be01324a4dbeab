"""`swarm hand unplug ROBOT DEVICE`: take a device off a simulated robot's I2C bus, or put it back."""

import argparse
from pathlib import Path

from sim.control.send_action import do
from sim.core import actions
from swarm.process.simulations import runtime_of

HELP = "take a device off a simulated robot's I2C bus (--back: put it back)"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`ROBOT imu|atmega|display [--back] [--run-dir DIR]`."""
    parser.add_argument("robot", help="name of a simulated robot, e.g. r0")
    parser.add_argument("device", choices=actions.DEVICES)
    parser.add_argument("--back", action="store_true", help="put it back")
    parser.add_argument("--run-dir", type=Path, help="of the simulation, where it was started with one")


def run(args: argparse.Namespace) -> int:
    """Raises `LocalError` where there is no such simulation or robot."""
    do(runtime_of(args.run_dir, args.robot), actions.Unplug(args.device, back=args.back))
    print(f"{args.robot}: {args.device} is {'back on' if args.back else 'off'} its bus")
    return 0
