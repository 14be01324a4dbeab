"""A robot for tests of how the balancer ends: its I2C bus notes each motor command in a file, and can be made to break.

Started as a process with the file's path; while `PATH.bug` exists, the bus raises what no driver expects.
"""

import sys
from pathlib import Path

from services.balancer.core.devices import balboa
from services.balancer.loop import main
from sim.devices.wiring import simulated_bus
from swarm.process.edges import run

record = Path(sys.argv[1])


class RecordingBus:
    def __init__(self, bus) -> None:
        self._bus = bus
        self.write_read = bus.write_read
        self.read = bus.read
        self.untimed = bus.untimed
        self._file = record.open("a", buffering=1)
        self._writes = 0

    def write(self, address: int, data: bytes) -> None:
        self._writes += 1
        if self._writes % 10 == 0 and record.with_suffix(".bug").exists():
            raise ZeroDivisionError("a bug")
        self._bus.write(address, data)
        if address == balboa.ADDRESS and data[0] == balboa.MOTORS:
            self._file.write(f"{balboa.decode_motors(data[1:])[0]}\n")

    def pause(self, seconds: float) -> None:
        self._bus.pause(seconds)

    def close(self) -> None:
        self._file.write("closed\n")
        self._file.close()
        self._bus.close()


run(lambda: main(lambda config, robot: RecordingBus(simulated_bus(config, robot)), start_mode="stand"))
