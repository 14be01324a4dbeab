"""The interface of a balancing regulator: it gets the body's deviation, and gives one duty for both motors.

`lqr` (`feedback.py`), `pololu` and `thesis` (`pololu.py`) are chosen by `controller` in [balancing] of `swarm.toml`.
Heading is none of theirs: the difference between the motors is added afterwards (`drive.py`).
"""

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from services.balancer.core.parameters import BalancerParameter

DUTY_LIMIT = 0.75
"""300 of 400, Pololu's limit for the sake of the motors."""


class Deviation(NamedTuple):
    """The deviation of the body from its desired state."""

    way: float
    """m ahead of the place."""
    speed: float
    """m/s faster than demanded."""
    tilt: float
    """rad from the balance point."""
    tilt_rate: float
    """rad/s."""
    dt: float
    """Seconds since the last tick."""


class Demand(NamedTuple):
    """Motion of the place itself."""

    speed: float
    """m/s."""
    acceleration: float
    """m/s^2."""


STANDSTILL = Demand(0.0, 0.0)


class Regulator(Protocol):
    """A balancing controller."""

    parameters: Mapping[str, BalancerParameter]
    """What may be changed while it runs, with the values it begins with."""

    limit: float
    """The largest command."""

    @property
    def tilt_per_way(self) -> float:
        """rad a metre: this error of upright makes it stand a metre off; 0 where it finds upright by itself."""

    def tune(self, values: Mapping[str, float]) -> None:
        """Take over changed values of `parameters`."""

    def reset(self, duty: float, tilt: float) -> None:
        """Begin after `duty` was commanded, at a tilt of `tilt` from the balance point."""

    def duty(self, off: Deviation, demand: Demand) -> float:
        """Return the next command of both motors, -limit..limit."""


def limited(value: float, limit: float) -> float:
    """Limit `value` to -limit..limit."""
    return min(limit, max(-limit, value))
