"""A command of `swarm` that works on robots of a simulation and on real ones: which are meant, and how it reaches them.

In a simulation that runs here, or on a robot, the command speaks to the buses itself. Otherwise the robots of the
configuration are meant, each of which runs its own `swarm` over ssh: no socket of its bus is opened to the laptop.
"""

import argparse
import os
import shlex
from collections.abc import Sequence
from pathlib import Path

from laptop.fleet.ssh import everyone
from laptop.fleet.ssh.ssh import CURRENT, Host
from swarm.config import find
from swarm.errors import LocalError
from swarm.onboard.buses import buses
from swarm.process.arguments import add_run_dir
from swarm.process.paths import DEFAULT_RUNTIME
from swarm.process.simulations import default_run_dir, is_live, robots


def add_real(parser: argparse.ArgumentParser, *also: str) -> None:
    """Declare `--real`, `also` under other names."""
    text = "the robots of the config, even if a simulation runs here"
    parser.add_argument("--real", *also, action="store_true", help=text)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `--real`, `--config` and `--ssh-config`: the way to real robots."""
    add_real(parser)
    everyone.add_config(parser, "swarm.toml with the robots and their hosts, for ssh")


def _names_real(args: argparse.Namespace) -> bool:
    """Return whether the options name real robots. Raises `LocalError` where they name a simulation as well."""
    real = bool(args.real or args.config or args.ssh_config)
    if real and args.run_dir:
        raise LocalError("--run-dir means a simulation, and --real, --config and --ssh-config real robots: choose one")
    return real


def is_far(args: argparse.Namespace) -> bool:
    """Return whether real robots are meant that ssh reaches. Raises `LocalError` where two swarms are meant."""
    if _names_real(args):
        return True
    if args.run_dir or os.environ.get("SWARM_RUNTIME") or DEFAULT_RUNTIME.is_dir():
        return False
    return not is_live(default_run_dir().absolute())


def is_meant(args: argparse.Namespace) -> bool:
    """Return whether `is_far` holds and a configuration exists. Where none exists the command names the missing
    simulation."""
    return is_far(args) and (args.config is not None or find.find() is not None)


def add_simulation(parser: argparse.ArgumentParser) -> None:
    """Declare `--run-dir` and `--real`, beside the way to real robots that `everyone` declares."""
    add_run_dir(parser)
    add_real(parser)


def simulated(args: argparse.Namespace) -> dict[str, Path] | None:
    """Return the runtime directories of the simulated robots that are meant; None where real ones are. Raises
    `LocalError`."""
    if _names_real(args):
        return None
    directory = (args.run_dir or default_run_dir()).absolute()
    if is_live(directory):
        if not (found := robots(directory)):
            raise LocalError(f"the simulation in {directory} has no robots at this moment: it starts or ends")
        return buses.only_wanted(found, args.robots or ())
    if args.run_dir is not None:
        raise LocalError(f"no simulation is running in {directory}")
    return None


def words(host: Host, arguments: Sequence[str]) -> str:
    """Return the line for the robot's shell that runs `swarm ARGUMENTS` there, on its own bus."""
    variables = [f"SWARM_ROBOT={host.robot}", f"SWARM_RUNTIME={DEFAULT_RUNTIME}"]
    return shlex.join(["sudo", "-n", "env", *variables, f"{CURRENT}/bin/swarm", *arguments])
