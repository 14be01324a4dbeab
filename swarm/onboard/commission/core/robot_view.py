"""The messages of a robot so far, as far as commissioning needs them."""

import math
from collections import deque
from itertools import pairwise
from statistics import fmean, pstdev

from swarm.frozen import frozen
from swarm.messages import (
    BalancerFault,
    BalancerState,
    Buttons,
    Display,
    Firmware,
    I2CRates,
    ImuSample,
    Links,
    Notice,
    Odometry,
    Ranges,
    Stopped,
)

KEPT_SAMPLES = 4000
"""IMU samples kept: 80 s at 50 Hz, longer than any motion of the hand that is integrated."""
KEPT_STATES = 1000
SPEED_S = 0.12
"""Seconds of odometry that a wheel's speed is taken from: three messages."""

_NEWEST: dict[type, str] = {
    BalancerState: "state",
    BalancerFault: "fault",
    Firmware: "firmware",
    Buttons: "buttons",
    Display: "display",
    Links: "links",
    Stopped: "stopped",
}
"""Attribute of a `RobotView` for the newest message of each type."""
_KEPT: dict[type, str] = {
    BalancerState: "states",
    Odometry: "odometry",
    ImuSample: "imu",
    Ranges: "ranges",
    Notice: "notices",
}
"""Attribute of a `RobotView` for the last messages of each type."""

Vector = tuple[float, float, float]


@frozen
class ImuMean:
    """Means and standard deviations of some samples, by axis: X up, Y left, Z backward."""

    gyro: Vector
    """rad/s."""
    acceleration: Vector
    """m/s^2."""
    gyro_noise: Vector
    acceleration_noise: Vector


class RobotView:
    """The newest messages, and the last ones of the types that are looked at over some time."""

    def __init__(self) -> None:
        self.state: BalancerState | None = None
        self.fault = BalancerFault(0.0, "", "", "")
        self.firmware: Firmware | None = None
        self.buttons: Buttons | None = None
        self.display: Display | None = None
        self.links: Links | None = None
        self.stopped: Stopped | None = None
        self.rates: dict[str, I2CRates] = {}
        """Measured rates, by ticket."""
        self.notices: deque[Notice] = deque(maxlen=20)
        self.states: deque[BalancerState] = deque(maxlen=KEPT_STATES)
        self.odometry: deque[Odometry] = deque(maxlen=KEPT_STATES)
        self.imu: deque[ImuSample] = deque(maxlen=KEPT_SAMPLES)
        self.ranges: deque[Ranges] = deque(maxlen=KEPT_STATES)

    def receive(self, message: object) -> None:
        """Keep a message. A message that is none of these does nothing."""
        kind = type(message)
        if kind in _NEWEST:
            setattr(self, _NEWEST[kind], message)
        if kind in _KEPT:
            getattr(self, _KEPT[kind]).append(message)
        if isinstance(message, I2CRates):
            self.rates[message.ticket] = message

    @property
    def mode(self) -> str:
        """Return the balancer's mode; empty before its first message."""
        return "" if self.state is None else self.state.mode

    def rolled(self) -> tuple[float, float]:
        """Return how far the left and right wheel have rolled, m: sums since the balancer started."""
        return (self.odometry[-1].left, self.odometry[-1].right) if self.odometry else (0.0, 0.0)

    def rolled_since(self, before: tuple[float, float]) -> tuple[float, float]:
        """Return how far the left and right wheel have rolled since `rolled` was `before`, m."""
        left, right = self.rolled()
        return left - before[0], right - before[1]

    def wheel_speed(self) -> float:
        """Return the speed of the faster wheel over the last messages, m/s; infinity where there are too few."""
        if len(self.odometry) < 2:
            return math.inf
        last = self.odometry[-1]
        first = next((each for each in reversed(self.odometry) if each.t <= last.t - SPEED_S), self.odometry[0])
        span = last.t - first.t
        return max(abs(last.left - first.left), abs(last.right - first.right)) / span if span > 0.0 else math.inf

    def imu_mean(self) -> ImuMean:
        """Return means and deviations of the samples that are kept: at least one."""
        gyro = list(zip(*(each.gyro for each in self.imu), strict=True))
        acceleration = list(zip(*(each.acceleration for each in self.imu), strict=True))
        return ImuMean(_each(gyro, fmean), _each(acceleration, fmean), _each(gyro, pstdev), _each(acceleration, pstdev))

    def turned(self, axis: int, zero: float) -> float:
        """Return the angle about an axis of the gyro over the samples that are kept, rad; `zero`: its rate at rest."""
        samples = list(self.imu)
        return sum(
            (later.t - one.t) * ((one.gyro[axis] + later.gyro[axis]) / 2 - zero) for one, later in pairwise(samples)
        )


def _each(axes: list[tuple[float, ...]], figure: object) -> Vector:
    assert callable(figure)
    x, y, z = (float(figure(axis)) for axis in axes)
    return x, y, z
