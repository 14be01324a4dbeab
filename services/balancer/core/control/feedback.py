"""State feedback u = k . (x, x', th, th', previous u) with gains from the Riccati equation (`lqr.py`).

A moving place is followed by feed-forward from the same model: the duty that drives at a speed, the lean that goes with
an acceleration.
"""

from collections.abc import Mapping

from services.balancer.core.control import lqr
from services.balancer.core.control.body import BodyModel
from services.balancer.core.control.regulator import DUTY_LIMIT, Demand, Deviation, limited
from services.balancer.core.parameters import BalancerParameter, around

GAINS = ("k_way", "k_speed", "k_tilt", "k_tilt_rate", "k_last")


class StateFeedback:
    """The regulator `lqr`; see `Regulator`."""

    limit = DUTY_LIMIT

    def __init__(self, body: BodyModel) -> None:
        self._gains = lqr.gains(body)
        self.parameters: Mapping[str, BalancerParameter] = {
            name: around(gain) for name, gain in zip(GAINS, self._gains, strict=True)
        }
        self._duty_per_speed, self._tilt_per_acceleration, self._duty_per_acceleration = lqr.feed_forward(body)
        self._last = 0.0

    @property
    def tilt_per_way(self) -> float:
        return self._gains[0] / self._gains[2]

    def tune(self, values: Mapping[str, float]) -> None:
        self._gains = tuple(values[name] for name in GAINS)

    def reset(self, duty: float, tilt: float) -> None:
        del tilt
        self._last = duty

    def duty(self, off: Deviation, demand: Demand) -> float:
        k_x, k_v, k_th, k_rate, k_u = self._gains
        ahead = self._duty_per_speed * demand.speed + self._duty_per_acceleration * demand.acceleration
        lean = self._tilt_per_acceleration * demand.acceleration
        duty = ahead + k_x * off.way + k_v * off.speed + k_th * (off.tilt - lean) + k_rate * off.tilt_rate
        duty = limited(duty + k_u * self._last, DUTY_LIMIT)
        self._last = duty - ahead
        return duty
