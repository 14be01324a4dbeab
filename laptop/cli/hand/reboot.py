"""`swarm hand reboot ROBOT`: switch a simulated robot off and on again."""

import argparse
from pathlib import Path

from sim.control import power_switch
from swarm.process.simulations import runtime_of

HELP = "switch a simulated robot off and on: what is not on its disk is lost"

BOOT_S = 3.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`ROBOT [--off S] [--run-dir DIR]`."""
    parser.add_argument("robot", help="name of a simulated robot, e.g. r0")
    parser.add_argument(
        "--off", type=float, default=BOOT_S, metavar="S", help=f"s until its services start again ({BOOT_S:g})"
    )
    parser.add_argument("--run-dir", type=Path, help="of the simulation, where it was started with one")


def run(args: argparse.Namespace) -> int:
    """Raises `LocalError` where there is no such simulation or robot."""
    runtime = runtime_of(args.run_dir, args.robot)
    power_switch.reboot(runtime.parent, args.robot, args.off)
    print(f"{args.robot}: off, and on again in {args.off:g} s")
    return 0
