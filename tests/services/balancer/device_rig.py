"""The drivers of IMU and ATmega on a simulated robot's bus, with a clock that the test sets."""

import random

from balancer_rig import CONFIGURED, NO_ERRORS

from services.balancer.device_drivers import Balboa, Imu
from sim.core.balboa import BalboaBody
from sim.core.devices import ImuErrors, SimulatedRobot
from sim.devices.i2c import SimulatedBus


class Bench:
    """The simulated devices and drivers on a clock set by hand."""

    def __init__(
        self, *, tilt: float = 0.0, held: bool = True, trim: float = 0.0, errors: ImuErrors = NO_ERRORS
    ) -> None:
        self.now = 10.0
        self.body = BalboaBody(CONFIGURED, self.now, tilt=tilt, held=held)
        self.robot = SimulatedRobot(self.body, random.Random(1), errors=errors, trim=trim)
        self.bus = SimulatedBus(self.robot, lambda: self.now)
        self.imu = Imu(self.bus)
        self.slept: list[float] = []
        self.balboa = Balboa(self.bus, lambda: self.now, self.slept.append)
