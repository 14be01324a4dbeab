"""In a machine of the lab, as root: its simulated robot behind a live /dev/i2c-1, until the machine goes off.

The body and the devices are those of `sim.body`. At a datagram socket faults are ordered, JSON of fields of
`Faults`; each order is answered with how the robot is.
"""

import errno
import json
import os
import select
import socket
import time
from pathlib import Path
from typing import Self

from lab.i2c.cuse import LARGEST, Cuse
from lab.i2c.firmware import Chip, solder
from lab.i2c.ioctls import I2CDevice
from lab.i2c.robot import RobotAdapter
from sim.devices.wiring import simulated_bus
from swarm import clock
from swarm.config import Config
from swarm.process.edges import notify

NAME = "i2c-1"
LOOK_MS = 50


class Memory:
    """Of the process that calls; see `lab.i2c.cuse.Memory`. The last one's stays open: it is the balancer's, and to
    open it costs as much as all that is read and written of it."""

    def __init__(self) -> None:
        self._process = 0
        self._file = -1

    def of(self, process: int) -> Self:
        """The memory of the process with that id; `OSError` where there is none."""
        if process != self._process:
            self._open(process)
        return self

    def read(self, address: int, size: int) -> bytes:
        """See there."""
        data = self._pread(address, size)
        if len(data) != size:
            # Of a program that has ended since, or has become another one, nothing is left.
            self._open(self._process)
            data = self._pread(address, size)
        if len(data) != size:
            raise OSError(errno.EFAULT, f"no {size} bytes at {address:#x}")
        return data

    def write(self, address: int, data: bytes) -> None:
        """See there."""
        written = self._pwrite(address, data)
        if written != len(data):
            self._open(self._process)
            written = self._pwrite(address, data)
        if written != len(data):
            raise OSError(errno.EFAULT, f"no room for {len(data)} bytes at {address:#x}")

    def _open(self, process: int) -> None:
        if self._file >= 0:
            os.close(self._file)
        self._process, self._file = 0, -1
        self._file = os.open(f"/proc/{process}/mem", os.O_RDWR)
        self._process = process

    def _pread(self, address: int, size: int) -> bytes:
        try:
            return os.pread(self._file, size, address)
        except (OSError, OverflowError):
            return b""

    def _pwrite(self, address: int, data: bytes) -> int:
        try:
            return os.pwrite(self._file, data, address)
        except (OSError, OverflowError):
            return -1


def serve(config: Config, robot: str, orders_at: str, chip: Chip | None = None) -> None:
    """Serve; systemd is notified when the device is there. `orders_at` is the path of the socket; `chip`, where there
    is one, takes the place of the simulated ATmega."""
    bus = simulated_bus(config, robot)
    if chip is not None:
        solder(bus.robot, chip, clock.now)
    adapter = RobotAdapter(bus, clock.now, time.sleep)
    cuse = Cuse(NAME, I2CDevice(adapter), Memory().of)
    orders = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    Path(orders_at).unlink(missing_ok=True)
    orders.bind(orders_at)
    device = os.open("/dev/cuse", os.O_RDWR)
    poll = select.poll()
    for file in (device, orders.fileno()):
        poll.register(file, select.POLLIN)
    announced = False
    while True:
        if not announced and Path("/dev", NAME).exists():
            announced = True
            notify("READY=1")
        for ready, _ in poll.poll(None if announced else LOOK_MS):
            if ready == device:
                answer = cuse.receive(os.read(device, LARGEST))
                if answer is not None:
                    os.write(device, answer)
            else:
                data, sender = orders.recvfrom(4096)
                adapter.faults.order(json.loads(data))
                orders.sendto(json.dumps(adapter.report()).encode(), sender)
