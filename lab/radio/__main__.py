"""The radio as a process: `python -m lab.radio --control SOCKET (--vhci | --sockets FOLDER) ADDRESS...`.

With --vhci its controllers become adapters of this machine's own kernel (hci0, hci1, ... in the order of the
addresses). With --sockets there is a Unix socket for each, FOLDER/radio-N, at which one machine at a time has it. Runs
until its standard input ends. Debian's Python is enough for it.
"""

import argparse
import errno
import json
import math
import os
import random
import select
import socket
import sys
import time
from pathlib import Path
from typing import Any

from lab.radio.core import hci
from lab.radio.core.air import Air
from lab.radio.trace import Trace

VENDOR = 0xFF
"""Type byte of what /dev/vhci itself says; written with a 0 it asks for an adapter (hci_vhci.c)."""


class Vhci:
    """An adapter of our own kernel."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._device = os.open("/dev/vhci", os.O_RDWR | os.O_NONBLOCK)
        os.write(self._device, bytes((VENDOR, 0)))

    def fileno(self) -> int:
        """For select."""
        return self._device

    def read(self) -> list[bytes] | None:
        """Packets of the host."""
        try:
            packet = os.read(self._device, 4096)
        except BlockingIOError:
            return []
        return [packet] if packet and packet[0] != VENDOR else []

    def write(self, packet: bytes) -> bool:
        """A packet for the host; False where it has switched this adapter off, of which it says nothing itself."""
        try:
            os.write(self._device, packet)
        except OSError as error:
            if error.errno != errno.ENXIO:
                raise
            return False
        return True

    def close(self) -> None:
        """Unplug it."""
        os.close(self._device)


class Line:
    """The adapter of another machine, whose packets follow one another on a stream."""

    def __init__(self, address: str, sock: socket.socket) -> None:
        self.address = address
        self._sock = sock
        self._rest = b""

    def fileno(self) -> int:
        """For select."""
        return self._sock.fileno()

    def read(self) -> list[bytes] | None:
        """Packets of the host; None where its machine is off."""
        try:
            data = self._sock.recv(65536)
        except OSError:
            return None
        if not data:
            return None
        packets, self._rest = hci.split(self._rest + data)
        return packets

    def write(self, packet: bytes) -> bool:
        """A packet for the host; the end of its machine is found by reading."""
        try:
            self._sock.sendall(packet)
        except OSError:
            self._rest = b""
        return True

    def close(self) -> None:
        """Unplug it."""
        self._sock.close()


class Process:
    """The air with its adapters, and who orders it about."""

    def __init__(self, control: Path, seed: int, trace: Trace | None) -> None:
        draw = random.Random(seed)
        self._air = Air(draw, lambda: draw.randbytes(16))
        self._trace = trace
        self._began = time.monotonic()
        self._numbers: dict[str, int] = {}
        self._adapters: dict[str, Vhci | Line] = {}
        self._doors: dict[socket.socket, str] = {}
        control.unlink(missing_ok=True)
        self._control = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._control.bind(str(control))

    def open(self, address: str, folder: Path | None, number: int) -> None:
        """An adapter here, or a door for one elsewhere."""
        self._numbers.setdefault(address, len(self._numbers))
        if folder is None:
            self._plug(Vhci(address))
        else:
            door = socket.socket(socket.AF_UNIX)
            path = folder / f"radio-{number}"
            path.unlink(missing_ok=True)
            door.bind(str(path))
            door.listen(1)
            self._doors[door] = address

    def run(self) -> None:
        """Until standard input ends."""
        while True:
            deadline = self._air.next_deadline()
            timeout = None if math.isinf(deadline) else max(0.0, deadline - self._now())
            adapters = list(self._adapters.values())
            ready, _, _ = select.select([*adapters, *self._doors, self._control, sys.stdin], [], [], timeout)
            now = self._now()
            self._air.handle_timer(now)
            if sys.stdin in ready:
                return
            for adapter in adapters:
                if adapter in ready:
                    packets = adapter.read()
                    if packets is None:
                        self._unplug(adapter.address)
                    for packet in packets or ():
                        if self._trace is not None:
                            self._trace.from_host(self._numbers[adapter.address], packet)
                        self._air.receive(adapter.address, packet, now)
            for door, address in self._doors.items():
                if door in ready:
                    self._unplug(address)  # its machine was cut off and we have not seen the end yet
                    self._plug(Line(address, door.accept()[0]))
            if self._control in ready:
                self._obey()
            self._air.handle_timer(self._now())
            for address, packet in self._air.to_send():
                if address not in self._adapters:
                    continue
                if self._trace is not None:
                    self._trace.to_host(self._numbers[address], packet)
                if not self._adapters[address].write(packet):
                    self._air.switch_off(address)

    def _now(self) -> float:
        return time.monotonic() - self._began

    def _plug(self, adapter: Vhci | Line) -> None:
        self._air.add(adapter.address)
        self._adapters[adapter.address] = adapter
        if self._trace is not None:
            self._trace.adapter(self._numbers[adapter.address], adapter.address)

    def _unplug(self, address: str) -> None:
        if address in self._adapters:
            self._air.remove(address)
            self._adapters.pop(address).close()

    def _obey(self) -> None:
        data, sender = self._control.recvfrom(65536)
        order = json.loads(data)
        try:
            answer = {"result": self._do(order.pop("do"), order)}
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        self._control.sendto(json.dumps(answer).encode(), sender)

    def _do(self, what: str, order: dict[str, Any]) -> Any:
        air = self._air
        if what in ("cut", "mend", "silence", "unsilence", "place", "topology", "drop", "change"):
            return getattr(air, what)(**order)
        if what == "unplug":
            return self._unplug(order["address"])
        if what == "plug":
            return self.open(order["address"], None, 0)
        if what == "look":
            return {
                "links": air.links(),
                "encrypted": air.encrypted(),
                "counts": dict(air.counts),
                "scans": air.scans(),
            }
        raise ValueError(f"no order {what}")


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(prog="lab.radio")
    parser.add_argument("--control", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--trace", type=Path, help="write all packets to this file, for btmon -r")
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--vhci", action="store_true")
    where.add_argument("--sockets", type=Path)
    parser.add_argument("addresses", nargs="+")
    asked = parser.parse_args()
    process = Process(asked.control, asked.seed, None if asked.trace is None else Trace(asked.trace))
    for number, address in enumerate(asked.addresses):
        process.open(address, asked.sockets, number)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    process.run()


if __name__ == "__main__":
    main()
