"""The robots' buses that a command uses: those of a simulation that runs here, or this robot's own."""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from swarm.config import load, who_am_i
from swarm.errors import LocalError
from swarm.process.arguments import add_robots, add_run_dir
from swarm.process.paths import DEFAULT_RUNTIME, runtime_dir
from swarm.process.simulations import default_run_dir, is_live, robots


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_robots(parser, "names of robots (default: all of a simulation; on a robot this robot only)")
    add_run_dir(parser)


def directories_of(arguments: argparse.Namespace) -> dict[str, Path]:
    """Return the runtime directory by robot, of a simulation's robots or of this one. Raises `LocalError`."""
    wanted: Sequence[str] = arguments.robots or ()
    if os.environ.get("SWARM_RUNTIME") and arguments.run_dir is None:
        return {_checked(who_am_i(load()), wanted): runtime_dir()}
    directory = (arguments.run_dir or default_run_dir()).absolute()
    if is_live(directory):
        return only_wanted(robots(directory), wanted)
    if arguments.run_dir is not None or not DEFAULT_RUNTIME.is_dir():
        elsewhere = (
            f", and this is no robot ({DEFAULT_RUNTIME} is not there); `swarm sim` starts a simulation, --run-dir "
            "names another one, and a swarm.toml (--config) names real robots"
        )
        raise LocalError(f"no simulation is running in {directory}" + ("" if arguments.run_dir else elsewhere))
    return {_checked(who_am_i(load()), wanted): DEFAULT_RUNTIME}


def all_directories(run_dir: Path | None) -> dict[str, Path]:
    """Return the runtime directories of all robots here, whichever a command names. Raises `LocalError`."""
    return directories_of(argparse.Namespace(robots=None, run_dir=run_dir))


def only_wanted(found: dict[str, Path], wanted: Sequence[str]) -> dict[str, Path]:
    """Return those of a simulation's robots that are wanted, all where none is named. Raises `LocalError`."""
    if strange := [name for name in wanted if name not in found]:
        raise LocalError(f"no robot {strange[0]!r} in the simulation, there are {', '.join(found)}")
    return {name: found[name] for name in wanted} if wanted else found


def _checked(me: str, wanted: Sequence[str]) -> str:
    if wanted and list(wanted) != [me]:
        raise LocalError(f"this is {me}; ask {' '.join(wanted)} itself, for example by ssh")
    return me
