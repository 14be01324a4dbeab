"""`swarm discover`: Bluetooth devices in range, and which of them are robots of the swarm.

For writing a swarm.toml, and for seeing what a radio sees. Needs PyBluez (python3-bluez).
"""

import argparse
import json

from services.mesh.links import pybluez
from swarm.config import load
from swarm.errors import ConfigError, LocalError
from swarm.process.arguments import number
from swarm.process.terminal import write_lines

HELP = "list Bluetooth devices in range, and which are robots"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare how long is searched, and how much is asked."""
    parser.add_argument(
        "--seconds",
        type=number(0, unit="s", above=True),
        default=8 * pybluez.INQUIRY_UNIT,
        metavar="S",
        help="length of the search (10.24)",
    )
    parser.add_argument(
        "--adapter", default="", metavar="NAME", help="adapter that searches: hci1, or its address (default: the first)"
    )
    parser.add_argument("--services", action="store_true", help="ask each device whether it has a mesh (slow)")
    parser.add_argument("--json", action="store_true", help="one JSON object a line")


def run(args: argparse.Namespace) -> int:
    """Print what answers an inquiry. Raises `LocalError` where none can be made."""
    try:
        lines = _lines(args)
    except OSError as error:
        raise LocalError(f"no Bluetooth inquiry: {error}") from None
    write_lines(lines)  # anybody in range may name a device
    return 0


def _lines(arguments: argparse.Namespace) -> list[str]:
    robots = _robots()
    lines = []
    for found in pybluez.discover(arguments.seconds, ask_services=arguments.services, adapter=arguments.adapter):
        robot = robots.get(found.address)
        if arguments.json:
            shown = {"address": found.address, "name": found.name, "robot": robot, "channel": found.channel}
            lines.append(json.dumps(shown))
        else:
            mesh = f"mesh on channel {found.channel}" if found.channel is not None else ""
            lines.append(f"{found.address}  {robot or '-':<16}  {found.name:<24}  {mesh}".rstrip())
    return lines


def _robots() -> dict[str, str]:
    """Known addresses, where there is a swarm.toml."""
    try:
        config = load()
    except ConfigError:
        return {}
    return {robot.bluetooth: robot.name for robot in config.robots if robot.bluetooth is not None}
