"""`swarm app start|stop NAME [ROBOT...]`: another app on the robots of a running simulation, beside those that run."""

import argparse
from pathlib import Path

from sim.control import app_requests
from swarm.process.simulations import robots, running

HELP = "start or stop an app on simulated robots, beside those that run"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`start|stop NAME [ROBOT...] [--run-dir DIR]`."""
    parser.add_argument("act", choices=app_requests.ACTS)
    parser.add_argument("app", help="a built-in app")
    parser.add_argument("robots", nargs="*", metavar="ROBOT", help="which robots (all)")
    parser.add_argument("--run-dir", type=Path, help="of the simulation, where it was started with one")


def run(args: argparse.Namespace) -> int:
    """Raises `LocalError` where there is no such simulation, robot or app."""
    run_dir = running(args.run_dir)
    print(app_requests.give(run_dir, args.act, args.app, args.robots or list(robots(run_dir))))
    return 0
