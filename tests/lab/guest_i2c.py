"""In the guest, as root: the simulated robot of this machine behind a live /dev/i2c-1, until it is told to end.

    python guest_i2c.py SOCKET

with SWARM_CONFIG, SWARM_ROBOT, SWARM_RUNTIME as for `services.sim.body`, whose body and devices these are. SOCKET is a
datagram socket: JSON of fields of `Faults` are ordered there, and each datagram is answered with how the robot is.
"""

import json
import os
import select
import socket
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

from cuse import LARGEST, Cuse
from i2c_dev import I2CDevice
from i2c_robot import Faults, RobotAdapter

from services.sim.body import simulated_bus
from swarm import clock
from swarm.config import load, who_am_i

NUMBER = 1


def order(faults: Faults, wanted: dict[str, Any]) -> None:
    """Take what is wanted; JSON has text where addresses belong."""
    names = {each.name for each in fields(Faults)}
    for name, value in wanted.items():
        assert name in names, name
        setattr(faults, name, {int(key): n for key, n in value.items()} if isinstance(value, dict) else value)


def main() -> None:
    """Serve."""
    config = load()
    bus = simulated_bus(config, who_am_i(config))
    adapter = RobotAdapter(bus, clock.now, time.sleep)
    cuse = Cuse(f"i2c-{NUMBER}", I2CDevice(adapter))
    orders = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    Path(sys.argv[1]).unlink(missing_ok=True)
    orders.bind(sys.argv[1])
    device = os.open("/dev/cuse", os.O_RDWR)
    poll = select.poll()
    poll.register(device, select.POLLIN)
    poll.register(orders, select.POLLIN)
    while True:
        for ready, _ in poll.poll():
            if ready == device:
                answer = cuse.receive(os.read(device, LARGEST))
                if answer is not None:
                    os.write(device, answer)
            else:
                data, sender = orders.recvfrom(4096)
                order(adapter.faults, json.loads(data))
                robot = bus.robot
                robot.atmega.advance(clock.now())
                found = {
                    "tilt": robot.body.tilt,
                    "held": robot.body.held,
                    "motors": robot.atmega.motors,
                    "transfers": adapter.transfers,
                    "failed": adapter.failed,
                    "timeout_s": adapter.timeout_s,
                }
                orders.sendto(json.dumps(found).encode(), sender)


if __name__ == "__main__":
    main()
