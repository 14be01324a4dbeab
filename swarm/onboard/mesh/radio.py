"""`swarm mesh --radio`: what this robot's Bluetooth adapter tells of its connections. Asking needs no rights."""

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from swarm.bluetooth import hci
from swarm.bluetooth.adapter import Adapter
from swarm.errors import LocalError
from swarm.frozen import frozen
from swarm.onboard.measure.rssi import address
from swarm.process.simulations import config_for
from swarm.process.terminal import columns


@frozen
class RadioReading:
    """An adapter's reading of one connection; None for a figure whose command the adapter does not know."""

    robot: str
    peer: str
    role: str
    """central or peripheral"""
    rssi: int | None
    """dB, as of `swarm.bluetooth.hci.Reading`"""
    quality: int | None
    """0 to 255"""
    failed: int | None
    """Packets in a row that were given up without an answer."""


def read(directories: Mapping[str, Path]) -> list[RadioReading]:
    """Return the readings of these robots' adapters. Raises `LocalError` for a robot without a radio or an answer."""
    found = []
    for robot, directory in directories.items():
        config = config_for(directory)
        own = address(config.robot(robot), robot)
        peers: dict[str, str] = {}
        for each in config.robots:
            if each.name != robot:
                with contextlib.suppress(LocalError):  # reached another way
                    peers[each.name] = address(each, robot)
        try:
            with contextlib.closing(Adapter(own)) as adapter:
                found += [
                    _reading(adapter, robot, peer, there)
                    for peer, there in peers.items()
                    if adapter.is_connected(there)
                ]
        except OSError as error:
            raise LocalError(f"Bluetooth {own}: {hci.explained(error)}") from None
    return found


def _reading(adapter: Adapter, robot: str, peer: str, there: str) -> RadioReading:
    rssi, quality, failed = (
        adapter.read(what, there) for what in (hci.READ_RSSI, hci.READ_QUALITY, hci.READ_FAILED_CONTACTS)
    )
    return RadioReading(robot, peer, "central" if adapter.is_central(there) else "peripheral", rssi, quality, failed)


def table(readings: Sequence[RadioReading]) -> list[str]:
    """Return the lines of a table, one for each connection."""
    rows: list[Sequence[str]] = [("radio", "role", "RSSI dB", "quality", "given up")]
    for each in readings:
        values = ["unknown" if value is None else str(value) for value in (each.rssi, each.quality, each.failed)]
        rows.append((f"{each.robot} {each.peer}", each.role, *values))
    return [*columns(rows), "retransmissions: unknown, no standard command of an adapter tells them"]
