"""`swarm measure rssi`: the signal of a Bluetooth link, as its adapter sees it.

Asked over a raw HCI socket, which needs neither root nor bluetoothd (`swarm.core.hci`); bluetoothd's own interface has
no such reading, and its management socket gives it to root only.
"""

import argparse
import contextlib
import errno
import fcntl
import json
import socket
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from swarm import clock
from swarm.cli.plots import figure
from swarm.config import load
from swarm.config.types import Robot
from swarm.core import hci
from swarm.errors import FrameError, LocalError
from swarm.simulations import CONFIG, is_live

PERIOD = 0.1
"""s between two readings."""

TIMEOUT = 1.0
"""s for an answer of the adapter."""

Open = Callable[[], socket.socket]
Ioctl = Callable[[Any, int, bytearray], object]

HINTS = {
    errno.EAFNOSUPPORT: "this kernel has no Bluetooth",
    errno.EPERM: "this kernel asks for CAP_NET_RAW here",
    errno.ENODEV: "the own Bluetooth adapter is not there or switched off (bluetoothctl list)",
    errno.ENETDOWN: "the own Bluetooth adapter is switched off (bluetoothctl power on)",
}


def open_socket() -> socket.socket:
    """A raw HCI socket; `LocalError` where this interpreter was built without."""
    if not hasattr(socket, "AF_BLUETOOTH"):
        raise LocalError("this Python was built without Bluetooth sockets; Debian's python3 has them")
    return socket.socket(socket.AF_BLUETOOTH, socket.SOCK_RAW, socket.BTPROTO_HCI)


class Signal:
    """The signal of one connection of an own adapter."""

    def __init__(self, adapter: str, peer: str, *, open_socket: Open = open_socket, ioctl: Ioctl = fcntl.ioctl) -> None:
        """`adapter` and `peer` are Bluetooth addresses. Raises `LocalError`, or OSError where the kernel refuses."""
        self._peer = peer
        self._ioctl = ioctl
        self._socket = open_socket()
        try:
            self._socket.settimeout(TIMEOUT)
            self._socket.bind((self._number(hci.packed_address(adapter), adapter),))
            self._socket.setsockopt(hci.SOL_HCI, hci.HCI_FILTER, hci.FILTER)
        except BaseException:
            self._socket.close()
            raise

    def close(self) -> None:
        """Let go of the adapter."""
        self._socket.close()

    def read(self) -> int:
        """One reading, dB; `LocalError` where there is no connection, or no answer."""
        handle = self._handle()
        self._socket.send(hci.read_rssi(handle))
        end = clock.now() + TIMEOUT
        while clock.now() < end:
            try:
                found = hci.reading(self._socket.recv(260))
            except TimeoutError:
                break
            except FrameError:
                continue
            if found is None or (found.status == 0 and found.handle != handle):
                continue  # others ask, too
            if found.status == hci.NO_CONNECTION:
                raise LocalError(f"there is no connection to {self._peer} any more")
            if found.status:
                raise LocalError(f"the adapter refuses: HCI status {found.status:#04x}")
            return found.rssi
        raise LocalError(f"the adapter does not answer ({TIMEOUT:g} s)")

    def _number(self, address: bytes, text: str) -> int:
        listed = hci.device_list()
        self._ioctl(self._socket, hci.DEVICE_LIST, listed)
        for number in hci.devices(listed):
            info = hci.device_info(number)
            self._ioctl(self._socket, hci.DEVICE_INFO, info)
            if hci.device_address(info) == address:
                return number
        raise LocalError(f"no Bluetooth adapter here has the address {text}: is this the robot?")

    def _handle(self) -> int:
        info = hci.connection_info(hci.packed_address(self._peer))
        try:
            self._ioctl(self._socket, hci.CONNECTION_INFO, info)
        except FileNotFoundError:
            raise LocalError(f"there is no Bluetooth connection to {self._peer}") from None
        return hci.connection_handle(info)


def run(args: argparse.Namespace, robot: str, peer: str, directory: Path) -> int:
    """Read `--count` times and print."""
    config = load(directory.parent / CONFIG if is_live(directory.parent) else None)
    if peer not in config.names:
        raise LocalError(f"there is no robot {peer}, there are {' '.join(config.names)}")
    adapter, address = (_radio(config.robot(name), robot, peer) for name in (robot, peer))
    try:
        with contextlib.closing(Signal(adapter, address)) as signal:
            readings = sample(signal, args.count)
    except OSError as error:
        hint = HINTS.get(error.errno or 0, "")
        raise LocalError(f"Bluetooth {adapter}: {error.strerror or error}{': ' if hint else ''}{hint}") from None
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


def _radio(config: Robot, robot: str, peer: str) -> str:
    if config.link is not None and not config.link.startswith("rfcomm:"):
        raise LocalError(f"{robot} - {peer}: this link has no radio: {config.name} is reached by {config.link}")
    address = (config.link or "").removeprefix("rfcomm:") or config.bluetooth
    if address is None:
        raise LocalError(f"{robot} - {peer}: this link has no radio: {config.name} has no Bluetooth address")
    return address
