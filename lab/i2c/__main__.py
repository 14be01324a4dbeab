"""In a machine of the lab, as root: its simulated robot behind a live /dev/i2c-1, until the machine goes off.

    python -m lab.i2c SOCKET

SWARM_CONFIG, SWARM_ROBOT and SWARM_RUNTIME as for `services.sim.body`, whose body and devices these are. At the
datagram socket SOCKET faults are ordered, JSON of fields of `Faults`; each order is answered with how the robot is.
systemd is notified when the device is there.
"""

import errno
import json
import os
import select
import socket
import sys
import time
from pathlib import Path
from typing import Self, cast

from lab.i2c.cuse import LARGEST, Cuse
from lab.i2c.ioctls import I2CDevice
from lab.i2c.robot import RobotAdapter
from services.sim.body import simulated_bus
from services.sim.i2c import SimulatedBus
from swarm import clock
from swarm.config import load, who_am_i
from swarm.process import notify

NAME = "i2c-1"
LOOK_MS = 50


class Memory:
    """Of the process with that id; see `lab.i2c.cuse.Memory`."""

    def __init__(self, process: int) -> None:
        self._path = f"/proc/{process}/mem"
        self._file = -1

    def __enter__(self) -> Self:
        self._file = os.open(self._path, os.O_RDWR)
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def read(self, address: int, size: int) -> bytes:
        """See there."""
        try:
            data = os.pread(self._file, size, address)
        except (OSError, OverflowError):
            data = b""
        if len(data) != size:
            raise OSError(errno.EFAULT, f"no {size} bytes at {address:#x}")
        return data

    def write(self, address: int, data: bytes) -> None:
        """See there."""
        try:
            written = os.pwrite(self._file, data, address)
        except (OSError, OverflowError):
            written = -1
        if written != len(data):
            raise OSError(errno.EFAULT, f"no room for {len(data)} bytes at {address:#x}")


def main() -> None:
    """Serve."""
    config = load()
    adapter = RobotAdapter(cast(SimulatedBus, simulated_bus(config, who_am_i(config))), clock.now, time.sleep)
    cuse = Cuse(NAME, I2CDevice(adapter), Memory)
    orders = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    Path(sys.argv[1]).unlink(missing_ok=True)
    orders.bind(sys.argv[1])
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


if __name__ == "__main__":
    main()
