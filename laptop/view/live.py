"""The feed of a swarm that runs now, as arguments name it: a simulation here, or real robots through ssh."""

import argparse
from typing import TYPE_CHECKING

from laptop.fleet.ssh import robot_command
from laptop.fleet.ssh.ssh import Ssh, hosts
from swarm.config import load
from swarm.process.arguments import add_robots, add_run_dir
from swarm.process.simulations import default_run_dir

if TYPE_CHECKING:
    from laptop.view.actions.control import Control
    from laptop.view.feeds.feed import SimulationFeed
    from laptop.view.feeds.robots import Robots


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments that name the swarm."""
    add_run_dir(parser)
    add_robots(parser, "these robots; of real ones those that ssh connects to, and one is enough to see all (all)")
    robot_command.add_arguments(parser)


def open_feed(args: argparse.Namespace) -> "tuple[SimulationFeed | Robots, Control]":
    """Return the feed, and what may be done to its robots: something only with `args.control`. The caller closes both.
    Raises `LocalError` where no such simulation runs, and `HostError` where no robot is reached."""
    # These are imported here, since the command line shows its help without the bus.
    from laptop.view.actions.control import Control
    from laptop.view.actions.remote_actions import RemoteActions
    from laptop.view.actions.simulated_actions import SimulatedActions
    from laptop.view.feeds.feed import SimulationFeed
    from laptop.view.feeds.robots import Robots

    if robot_command.is_meant(args):
        config = load(args.config, addressed=False)
        # A stop that the page gives must reach the robot at each address, whatever its name is.
        robots = Robots(config, hosts(config, args.robots), Ssh(args.ssh_config, named=False))
        return robots, Control(robots, RemoteActions(robots, Ssh(args.ssh_config)) if args.control else None)
    simulation = SimulationFeed((args.run_dir or default_run_dir()).absolute(), args.robots or ())
    return simulation, Control(simulation, SimulatedActions(simulation) if args.control else None)
