"""`swarm measure rssi ROBOT [ROBOT]`: the signal strength of a Bluetooth link (RSSI), as its adapter sees it.

The adapter is asked over a raw HCI socket, which needs neither root nor bluetoothd (`swarm.bluetooth.hci`).
bluetoothd's own interface has no such reading, and its management socket gives it to root only.
"""

import argparse
import contextlib
import statistics
import time

from swarm.bluetooth import hci
from swarm.bluetooth.adapter import Adapter
from swarm.config.types import RobotConfig
from swarm.errors import LocalError
from swarm.onboard.measure import links
from swarm.process.arguments import show, whole
from swarm.process.simulations import config_for

PERIOD = 0.1
"""Seconds between two readings."""


def strength(adapter: Adapter, peer: str) -> int:
    """Read the strength of the signal from a Bluetooth address, dB. Raises `LocalError` without a connection or an
    answer."""
    found = adapter.read(hci.READ_RSSI, peer)
    if found is None:
        raise LocalError("the adapter does not tell the signal strength")
    return found


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare `ROBOT [ROBOT] [--count N]`."""
    links.add_ends(parser)
    parser.add_argument("--count", type=whole(1, 10_000), default=20, metavar="N", help="number of readings (20)")


def run(args: argparse.Namespace) -> int:
    measured(args)
    return 0


def measured(args: argparse.Namespace) -> tuple[str, list[int]]:
    """Read `--count` times and print; returns the link, and the readings in dB."""
    robot, peer, directory = links.ends(args)
    config = config_for(directory)
    if peer not in config.names:
        raise LocalError(f"there is no robot {peer}, there are {' '.join(config.names)}")
    link = f"{robot} - {peer}"
    own, there = (address(config.robot(name), link) for name in (robot, peer))
    try:
        with contextlib.closing(Adapter(own)) as adapter:
            readings = [strength(adapter, there)]
            while len(readings) < args.count:
                time.sleep(PERIOD)
                readings.append(strength(adapter, there))
    except OSError as error:
        raise LocalError(f"Bluetooth {own}: {hci.explained(error)}") from None
    data = {"robot": robot, "peer": peer, "what": "rssi", "period": PERIOD, "rssi": readings}
    show(args, data, text(link, readings))
    return link, readings


def text(link: str, readings: list[int]) -> list[str]:
    """Return the readings' statistics as lines for people."""
    mean, deviation = statistics.fmean(readings), statistics.pstdev(readings)
    return [
        f"{link}: RSSI of {len(readings)} readings: min {min(readings)}, median "
        f"{statistics.median(readings):g}, mean {mean:.1f}, max {max(readings)}, sd {deviation:.1f} dB",
        "(dBm, or relative to the adapter's golden range, as the adapter has it)",
    ]


def address(config: RobotConfig, link: str) -> str:
    """Return the Bluetooth address of a robot. Raises `LocalError`, with `link` in front, where it is reached
    otherwise."""
    if config.link is not None and not config.link.startswith("rfcomm:"):
        raise LocalError(f"{link}: this link has no radio: {config.name} is reached by {config.link}")
    found = (config.link or "").removeprefix("rfcomm:") or config.bluetooth
    if found is None:
        raise LocalError(f"{link}: this link has no radio: {config.name} has no Bluetooth address")
    return found
