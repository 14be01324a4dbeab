"""A whole robot in one piece of virtual time: the real firmware in the bench, the simulation's body and IMU around it.

`ElfRobot` is the I2C bus that the balancer's drivers see (services/balancer/i2c.py). The ATmega's address goes to the
ELF, whose PWM registers drive the body and whose encoder pins the body turns; the IMU is the simulation's own.
"""

import errno
import os
import random

from avr_bench import Bench
from firmware_layout import CONSTANTS

from lab.i2c.firmware import BodyAndChip
from services.balancer.core.control.body import BodyModel
from services.balancer.core.devices import imu
from sim.core.balboa import BalboaBody
from sim.core.devices import ImuDevice, draw_errors


class ElfRobot:
    """One robot; time is the simulated chip's."""

    def __init__(self, bench: Bench, model: BodyModel, *, seed: int = 1, trim: float = 0.0) -> None:
        self.bench = bench
        noise = random.Random(seed)
        self.body = BalboaBody(model, bench.now)
        self.imu = ImuDevice(self.body, noise, draw_errors(noise), trim)
        self._pair = BodyAndChip(bench, self.body)

    # time

    def clock(self) -> float:
        return self.bench.now

    def sleep(self, seconds: float) -> None:
        self.run_to(self.bench.now + seconds)

    def run_to(self, end: float) -> None:
        """Body and chip together, in steps of the body's integration."""
        self._pair.run_to(end)

    # I2C

    def write(self, address: int, data: bytes) -> None:
        self._pair.meet()
        if address == CONSTANTS["ADDRESS"]:
            self.bench.write(address, data)
        else:
            self._imu(address, len(data)).write(data, self.bench.now)

    def read(self, address: int, count: int) -> bytes:
        self._pair.meet()
        if address == CONSTANTS["ADDRESS"]:
            return self.bench.read(address, count)
        return self._imu(address, count).read(count, self.bench.now)

    def write_read(self, address: int, data: bytes, count: int) -> bytes:
        self._pair.meet()
        if address == CONSTANTS["ADDRESS"]:
            return self.bench.write_read(address, data, count)
        self._imu(address, len(data)).write(data, self.bench.now)
        return self._imu(address, count).read(count, self.bench.now)

    def recover(self) -> None:
        self.bench.call("i2c_wire", 2)

    def untimed(self) -> float:
        return 0.0

    def close(self) -> None:
        pass

    def _imu(self, address: int, count: int) -> ImuDevice:
        """The other device on the bus, once its transfer has taken its time on the wire."""
        self.bench.call("i2c_wire", 1 + count)
        if address != imu.ADDRESS:
            raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))
        self.body.advance(self.bench.now)
        return self.imu
