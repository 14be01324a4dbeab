"""Messages of the balancer."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class BalancerState:
    """The body, on `swarm/<robot>/balancer/state` at 25 Hz."""

    t: float
    mode: str
    """starting, idle, standing_up, balancing or fault."""
    tilt: float
    """From upright, rad; positive = falling forward."""
    tilt_rate: float
    """rad/s."""
    speed: float
    """Forward speed of the axle, m/s."""
    duty_left: float
    """Motor command, -1..1."""
    duty_right: float
    battery: float | None
    """V; None before it was read."""
    ticks: int
    """Control steps since the loop started."""
    late_p99: float
    """99th percentile of the loop's lateness over the last second, s."""
    late_max: float
    fault: str
    """Why the motors are off; empty when there is no fault."""
    missed: int = 0
    """Ticks left out since the start because the loop was late by a period or more."""
    bus_errors: int = 0
    """Failed I2C transfers since the start."""


@dataclass(frozen=True, slots=True)
class Odometry:
    """Wheel travel, on `swarm/<robot>/balancer/odometry` at 25 Hz; integrated at 100 Hz, nothing is lost."""

    t: float
    sequence: int
    left: float
    """Distance rolled by the left wheel since the loop started, corrected by body pitch, m."""
    right: float
    heading: float
    """Integrated from the wheels, rad, counter-clockwise positive, 0 at the start of the loop."""


@dataclass(frozen=True, slots=True)
class Leds:
    """LEDs as they are (`balancer/leds`) or shall be (`balancer/set/leds`)."""

    red: bool
    yellow: bool
    green: bool


@dataclass(frozen=True, slots=True)
class SetMode:
    """Command on `balancer/set/mode`."""

    mode: str
    """stand (stand up and balance) or rest (motors off)."""


TOPICS: dict[tuple[str, str], type] = {
    ("balancer", "state"): BalancerState,
    ("balancer", "odometry"): Odometry,
    ("balancer", "leds"): Leds,
    ("balancer", "set/leds"): Leds,
    ("balancer", "set/mode"): SetMode,
}
"""Message type of each key, by (service, topic); `*` is any one chunk."""
