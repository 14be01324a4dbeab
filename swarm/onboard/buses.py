"""Which robots' buses a command speaks to: those of a simulation that runs here, or this robot's own."""

import argparse
import os
from pathlib import Path

from swarm.config import load, who_am_i
from swarm.errors import LocalError
from swarm.process.paths import DEFAULT_RUNTIME, runtime_dir
from swarm.process.simulations import default_run_dir, is_live, robots


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """`--robot` and `--run-dir`."""
    parser.add_argument("--robot", metavar="NAME", help="this robot's view (of a simulation; else the own robot)")
    parser.add_argument("--run-dir", type=Path, metavar="DIR", help="of a simulation started with one")


def find(arguments: argparse.Namespace) -> dict[str, Path]:
    """Runtime directory by robot: all simulated ones, or `--robot`, or the own. Raises `LocalError`."""
    wanted: str | None = arguments.robot
    if os.environ.get("SWARM_RUNTIME") and arguments.run_dir is None:
        return {_checked(who_am_i(load()), wanted): runtime_dir()}
    directory = (arguments.run_dir or default_run_dir()).absolute()
    if is_live(directory):
        found = robots(directory)
        if wanted is not None and wanted not in found:
            raise LocalError(f"no robot {wanted!r} in the simulation, there are {', '.join(found)}")
        return found if wanted is None else {wanted: found[wanted]}
    if arguments.run_dir is not None or not DEFAULT_RUNTIME.is_dir():
        raise LocalError(
            f"no simulation is running in {directory}"
            + ("" if arguments.run_dir else f", and this is no robot ({DEFAULT_RUNTIME} is not there)")
        )
    return {_checked(who_am_i(load()), wanted): DEFAULT_RUNTIME}


def _checked(me: str, wanted: str | None) -> str:
    if wanted not in (None, me):
        raise LocalError(f"this is {me}; ask {wanted} itself, for example by ssh")
    return me
