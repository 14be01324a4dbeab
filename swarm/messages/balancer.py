"""Messages of the balancer."""

from swarm.frozen import frozen
from swarm.messages.codec import Measured, with_telemetry


@frozen
class BalancerState:
    """The body, on `swarm/<robot>/balancer/state` at 25 Hz."""

    t: float
    mode: str
    """starting, calibrating, idle, standing_up, balancing, lying_down, testing or fault."""
    tilt: float
    """Tilt from upright, rad; positive = falling forward."""
    tilt_rate: float
    """Rate of the tilt, rad/s."""
    speed: float
    """Forward speed of the axle, m/s."""
    duty_left: float
    """Motor command, -1..1."""
    duty_right: float
    battery: float | None
    """V; None before it was read, and where it was not read for 60 s."""
    ticks: int
    """Control steps since the loop started."""
    late_p99: float
    """99th percentile of the loop's lateness over the last second, s."""
    late_max: float
    fault: str
    """Why the motors are off; empty when there is no fault. `balancer/fault` says more."""
    missed: int = 0
    """Ticks left out since the start because the loop was late by a period or more."""
    bus_errors: int = 0
    """Failed I2C transfers since the start."""
    posture: str = "unknown"
    """upright, front (lying on it), back, leaning, or unknown before the first estimate: by the tilt alone."""
    demanded_speed: float = 0.0
    """The commanded speed after limits and ramps, m/s."""
    demanded_turn_rate: float = 0.0
    """The commanded turn rate after limits and ramps, rad/s to the left."""
    battery_level: str = "ok"
    """ok, low (a warning), empty, or unknown: not read for 60 s. With the last two it lies down, and does not stand
    up."""
    battery_left: float | None = None
    """Seconds until it lies down, a rough estimate; None where the battery's voltage is not known, and where the
    configured limit is above the voltage of the full NiMH battery that the estimate assumes."""
    scl: float = 0.0
    """Hz: the clock of the I2C bus as its transfers show it, the kernel's time for them included; 0 where unknown."""
    behind: str = ""
    """Tasks for which the I2C bus has no time, such as `uwb, display`; empty: it has time for all."""


@frozen
class Odometry:
    """Own motion, on `swarm/<robot>/balancer/odometry` at 25 Hz, integrated at 100 Hz by measured time.

    All values are sums since the loop started (`sequence` begins at 1 then): the difference of any two messages is the
    motion between them, so a lost one costs nothing.
    """

    t: float
    """The time of the control step."""
    sequence: int
    left: Measured
    """Distance rolled by the left wheel, corrected by body pitch, m."""
    right: Measured
    x: Measured
    """Place of the axle's middle from wheels and `heading`, in the frame of the start: x points ahead, m."""
    y: Measured
    """Distance to the left, m."""
    heading: Measured
    """Heading by gyro and wheels, rad, counter-clockwise positive, not wrapped: the gyro's zero is learned from the
    wheels."""
    gyro_heading: Measured
    """Heading by the gyro alone (its zero measured at rest, nothing learned), rad: for a filter with a bias of its
    own."""
    wheel_heading: Measured
    """Heading by the wheels alone: (right - left) / track, rad."""
    tilt: Measured
    """Tilt from upright, rad, at `t`."""


@frozen
class BalancerFault:
    """Why the motors are off, on `balancer/fault`: on change, and each second while there is a fault."""

    t: float
    name: str
    """fell, lifted, cannot_stand, bus, device, estimate, clock, battery or stopped; empty: there is no fault (any
    more)."""
    reason: str
    """The reason in words."""
    recovery: str
    """What a person must do. No fault ends by itself."""


@frozen
class Notice:
    """A notice that is no fault, on `balancer/notice`: a command was refused or cut, or the battery is low."""

    t: float
    about: str
    """mode, velocity, parameters, leds, calibrate or battery."""
    text: str


@frozen
class Parameters:
    """The settings that `set/parameters` may change, on `balancer/parameters`: on change and every ten seconds."""

    t: float
    controller: str
    """lqr, pololu or thesis."""
    parameters: dict[str, float]


@frozen
class Leds:
    """LEDs as they are, on `balancer/leds`."""

    t: float
    """The time at which they were written last."""
    red: bool
    yellow: bool
    green: bool


LONGEST_AHEAD_S = 10.0
"""The most seconds that the time of an order for the LEDs may be ahead."""


@frozen
class SetLeds:
    """Command on `balancer/set/leds`: the sender has the LEDs for a while."""

    red: bool
    yellow: bool
    green: bool
    seconds: float = 3.0
    """Seconds after which the LEDs show the balancer's own state again, at most 60."""
    at: float | None = None
    """The time from which the LEDs are set, by the robot's monotonic clock, at most 10 s ahead; None: at once. Earlier
    orders for that time or later are cancelled."""


@frozen
class SetMode:
    """Command on `balancer/set/mode`."""

    mode: str
    """stand (stand up and balance), rest (motors off), lie (lie down gently) or calibrate (the gyro, at rest)."""


@frozen
class SetVelocity:
    """Command on `balancer/set/velocity`: drive for a while. Without another one the robot stops and stands."""

    speed: float
    """Speed forward, m/s."""
    turn_rate: float
    """Turn rate to the left, rad/s."""
    seconds: float
    """Seconds for which the command is valid, at most 10."""


@frozen
class TryMotors:
    """Command on `balancer/set/motors`: turn wheels at low power without balancing. Only an idle robot does."""

    left: float
    """Duty, at most 0.2 either way; positive = forward."""
    right: float
    seconds: float
    """Seconds for which it runs, at most 10."""
    kind: str = "turn"
    """turn (these duties), watchdog (they are commanded once, so that the ATmega has to stop the motors), or tilt (the
    balancing controller's duty by the body's tilt alone, cut to 0.2)."""


@frozen
class SetParameters:
    """Command on `balancer/set/parameters`: change some, all or none of them."""

    parameters: dict[str, float]


TOPICS = with_telemetry(
    {
        ("balancer", "state"): BalancerState,
        ("balancer", "state/throttled"): BalancerState,
        ("balancer", "odometry"): Odometry,
        ("balancer", "leds"): Leds,
        ("balancer", "fault"): BalancerFault,
        ("balancer", "notice"): Notice,
        ("balancer", "parameters"): Parameters,
        ("balancer", "set/leds"): SetLeds,
        ("balancer", "set/mode"): SetMode,
        ("balancer", "set/motors"): TryMotors,
        ("balancer", "set/parameters"): SetParameters,
        ("balancer", "set/velocity"): SetVelocity,
    }
)
"""Message type of each key, by (service, topic); `*` is any one chunk."""
