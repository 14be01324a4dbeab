"""The algorithm of Pololu's Balboa balancing example, which the thesis used too, with constants of its own.

Every tick of 10 ms, in Pololu's units (millidegrees, encoder counts, motor units of 1/400):

    rising = rate * ANGLE_RATE_RATIO + angle
    motor += (ANGLE_RESPONSE * rising + DISTANCE_RESPONSE * (dl + dr) + SPEED_RESPONSE * (vl + vr)) / 100 / gear ratio

The output is integrated: the sum is an increment of speed. The angle leaks towards zero by 1/1000 a tick in place of an
accelerometer, so the controller finds upright by itself. Distances and speeds are those of the encoders, wheel against
body. Written from the published description (Balboa user's guide and Pololu's blog). Ticks of another length count by
their length.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

from services.balancer.core.control.body import BodyModel
from services.balancer.core.control.lqr import PERIOD_S
from services.balancer.core.control.regulator import Demand, Deviation, limited
from services.balancer.core.parameters import BalancerParameter


class Constants(NamedTuple):
    """The constants that were found by experiment."""

    angle_rate_ratio: float
    """ms: the time constant of falling."""
    angle_response: float
    distance_response: float
    speed_response: float
    limit: float
    """Limit of the duty."""


POLOLU = Constants(140.0, 11.0, 73.0, 3300.0, 300 / 400)
"""The constants of the example for the Balboa."""
THESIS = Constants(150.0, 7.0, 60.0, 1900.0, 250 / 400)
"""The constants of the thesis' program."""

LEAK = 1e-3
"""The share of the angle that is lost in a tick."""

_MOTOR_UNITS = 400.0


class Pololu:
    """The regulators `pololu` and `thesis`; see `Regulator`."""

    tilt_per_way = 0.0

    def __init__(self, body: BodyModel, constants: Constants) -> None:
        self.parameters: Mapping[str, BalancerParameter] = {
            "angle_rate_ratio": BalancerParameter(constants.angle_rate_ratio, 50.0, 400.0),
            "angle_response": BalancerParameter(constants.angle_response, 2.0, 30.0),
            "distance_response": BalancerParameter(constants.distance_response, 0.0, 300.0),
            "speed_response": BalancerParameter(constants.speed_response, 500.0, 9000.0),
        }
        self.limit = constants.limit
        self._radius = body.wheel_radius
        self._counts_per_radian = body.counts_per_turn / math.tau
        self._gear_ratio = body.counts_per_turn / 12
        self._values = {name: parameter.value for name, parameter in self.parameters.items()}
        self._motor = self._angle = self._distance = 0.0

    def tune(self, values: Mapping[str, float]) -> None:
        self._values = {name: values[name] for name in self.parameters}

    def reset(self, duty: float, tilt: float) -> None:
        self._motor = duty * _MOTOR_UNITS
        self._angle = tilt
        self._distance = -2 * self._counts_per_radian * tilt

    def duty(self, off: Deviation, demand: Demand) -> float:
        """See `Regulator`. Driving moves the set-point of distance and speed, no more."""
        del demand
        ticks = off.dt / PERIOD_S
        self._angle = (self._angle + off.tilt_rate * off.dt) * (1.0 - LEAK * ticks)
        values = self._values
        per_radian = self._counts_per_radian
        # Both wheels: twice the mean.
        distance = 2 * per_radian * (off.way / self._radius - self._angle)
        # The way of this tick, whatever its length, in place of the speed: the estimate's speed is smoothed, and this
        # algorithm does not bear the lag.
        step = distance - self._distance
        self._distance = distance
        rising = math.degrees(off.tilt_rate) * values["angle_rate_ratio"] + 1e3 * math.degrees(self._angle)
        response = (
            ticks * (values["angle_response"] * rising + values["distance_response"] * distance)
            + values["speed_response"] * step
        )
        motor = self._motor + response / 100 / self._gear_ratio
        self._motor = limited(motor, self.limit * _MOTOR_UNITS)
        return self._motor / _MOTOR_UNITS
