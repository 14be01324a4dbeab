"""`swarm app start|stop NAME [ROBOT...]`: another app on the robots of a running simulation, beside those that run."""

import argparse

from sim.control import app_requests
from swarm.onboard.arguments import add_json, add_robots, add_run_dir, show
from swarm.process.simulations import robots, running


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `start|stop NAME [ROBOT...]`. The act is part of the command's name."""
    parser.add_argument("act", choices=app_requests.ACTS, help=argparse.SUPPRESS)
    parser.add_argument("app", help="a built-in app")
    parser.add_argument("which", nargs="*", metavar="ROBOT", help="which robots (all)")
    add_robots(parser, "the same as an option")
    add_run_dir(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Raises `LocalError` where there is no such simulation, robot or app."""
    run_dir = running(args.run_dir)
    done = app_requests.give(run_dir, args.act, args.app, [*args.which, *(args.robots or ())] or list(robots(run_dir)))
    show(args, {"app": args.app, "act": args.act, "done": done}, [done])
    return 0
