"""Messages of the simulated world."""

from swarm.frozen import frozen
from swarm.messages.codec import with_telemetry

TRUTH_PERIOD_S = 0.1
"""Seconds between two messages of a robot's truth ..."""
THROTTLED_TRUTH_S = 0.2
"""... and of its throttled copy."""


@frozen
class Truth:
    """True pose of a simulated robot, on `swarm/<robot>/sim/truth`."""

    t: float
    x: float
    y: float
    heading: float
    tilt: float


@frozen
class Target:
    """The true place of the simulated target, on `swarm/<robot>/sim/target` of every robot at 10 Hz, where it moves."""

    t: float
    x: float
    y: float


@frozen
class LedChange:
    """The LEDs of a simulated robot as its ATmega's registers have them, on `swarm/<robot>/sim/leds` on change."""

    t: float
    """The time at which the registers were written."""
    red: bool
    yellow: bool
    green: bool


TOPICS = with_telemetry(
    {
        ("sim", "leds"): LedChange,
        ("sim", "target"): Target,
        ("sim", "truth"): Truth,
        ("sim", "truth/throttled"): Truth,
    }
)
"""Message type of each key, by (service, topic); `*` is any one chunk."""
