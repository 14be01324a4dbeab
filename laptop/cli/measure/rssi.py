"""`swarm measure rssi`: the signal of a Bluetooth link, as its adapter sees it.

The adapter is asked over a raw HCI socket, which needs neither root nor bluetoothd (`swarm.bluetooth.hci`).
bluetoothd's own interface has no such reading, and its management socket gives it to root only.
"""

import argparse
import contextlib
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

from laptop.plotting.figure import figure
from swarm.bluetooth import hci
from swarm.bluetooth.adapter import Adapter, check
from swarm.config import load
from swarm.config.types import RobotConfig
from swarm.errors import LocalError
from swarm.process.simulations import CONFIG, is_live

PERIOD = 0.1
"""s between two readings."""


class Signal:
    """The signal of one connection of an own adapter."""

    def __init__(self, adapter: Adapter, peer: str) -> None:
        """`peer` is a Bluetooth address."""
        self._adapter = adapter
        self._peer = peer

    def read(self) -> int:
        """One reading, dB; `LocalError` where there is no connection, or no answer."""
        handle = self._adapter.handle(self._peer)

        def answer(packet: bytes) -> hci.RssiReading | None:
            found = hci.reading(packet)
            return None if found is not None and found.status == 0 and found.handle != handle else found

        found = self._adapter.ask(hci.read_rssi(handle), answer)
        if found.status == hci.NO_CONNECTION:
            raise LocalError(f"there is no connection to {self._peer} any more")
        check(found.status)
        return found.rssi


def run(args: argparse.Namespace, robot: str, peer: str, directory: Path) -> int:
    """Read `--count` times and print."""
    config = load(directory.parent / CONFIG if is_live(directory.parent) else None)
    if peer not in config.names:
        raise LocalError(f"there is no robot {peer}, there are {' '.join(config.names)}")
    own, address = (_radio(config.robot(name), robot, peer) for name in (robot, peer))
    try:
        with contextlib.closing(Adapter(own)) as adapter:
            readings = sample(Signal(adapter, address), args.count)
    except OSError as error:
        raise LocalError(f"Bluetooth {own}: {hci.explained(error)}") from None
    show(args, robot, peer, readings)
    return 0


def sample(signal: Signal, count: int, pause: Callable[[float], object] = time.sleep) -> list[int]:
    """Readings one after the other."""
    readings = [signal.read()]
    for _ in range(count - 1):
        pause(PERIOD)
        readings.append(signal.read())
    return readings


def show(args: argparse.Namespace, robot: str, peer: str, readings: list[int]) -> None:
    """Print, and draw where asked for."""
    mean, deviation = statistics.fmean(readings), statistics.pstdev(readings)
    if args.json:
        print(json.dumps({"robot": robot, "peer": peer, "what": "rssi", "period": PERIOD, "rssi": readings}))
    else:
        print(
            f"{robot} - {peer}: RSSI of {len(readings)} readings: min {min(readings)}, median "
            f"{statistics.median(readings):g}, mean {mean:.1f}, max {max(readings)}, sd {deviation:.1f} dB\n"
            "(dBm, or relative to the adapter's golden range, as the adapter has it)"
        )
    if args.plot is not None:
        with figure(args.plot, figsize=(6, 4), layout="constrained") as picture:
            axes = picture.add_subplot()
            axes.plot([PERIOD * number for number in range(len(readings))], readings, "o-")
            axes.set(xlabel="time / s", ylabel="RSSI / dB", title=f"{robot} - {peer}")


def _radio(config: RobotConfig, robot: str, peer: str) -> str:
    if config.link is not None and not config.link.startswith("rfcomm:"):
        raise LocalError(f"{robot} - {peer}: this link has no radio: {config.name} is reached by {config.link}")
    address = (config.link or "").removeprefix("rfcomm:") or config.bluetooth
    if address is None:
        raise LocalError(f"{robot} - {peer}: this link has no radio: {config.name} has no Bluetooth address")
    return address
