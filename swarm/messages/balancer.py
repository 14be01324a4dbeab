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
    """Own motion, on `swarm/<robot>/balancer/odometry` at 25 Hz, integrated at 100 Hz by measured time.

    All values are sums since the loop started (`sequence` begins at 1 then): the difference of any two messages is the
    motion between them, so a lost one costs nothing.
    """

    t: float
    """Of the control step."""
    sequence: int
    left: float
    """Distance rolled by the left wheel, corrected by body pitch, m."""
    right: float
    x: float
    """Way of the axle's middle by wheels and `heading`, in the frame of the start: x ahead, m."""
    y: float
    """To the left, m."""
    heading: float
    """By gyro and wheels, rad, counter-clockwise positive, not wrapped: the gyro's zero is learned from the wheels."""
    gyro_heading: float
    """By the gyro alone (its zero measured at rest, nothing learned), rad: for a filter with a bias of its own."""
    wheel_heading: float
    """By the wheels alone: (right - left) / track, rad."""
    tilt: float
    """From upright, rad, at `t`."""


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
