"""Messages of the UWB service."""

from dataclasses import field

from swarm.frozen import frozen
from swarm.messages.codec import Measured, with_telemetry
from swarm.messages.devices import ModuleAnswer, ModuleRequest


@frozen
class Range:
    """The distance to one anchor (or to the target, which is a module like any other)."""

    anchor: str
    """Short UWB address as printed on the module and in shell output, e.g. C933."""
    distance: float
    """The distance, calibrated and filtered as the service is configured, m."""
    raw: float
    """The distance as the module reported it, m."""
    quality: int
    """The quality as the module reported it, 0-100."""
    age: float
    """Age of the measurement at `t` of the message, s."""
    sequence: int
    """The number of measurements of this anchor so far. A repeated measurement keeps its number."""
    stale: bool = False
    """Whether the last measurement is older than the module's period; the numbers are of that time."""
    robot: str | None = None
    """The robot that carries this module; None for one that stands by itself."""


@frozen
class Ranges:
    """The ranges to all modules seen in the last seconds, on `swarm/<robot>/dwm/ranges` with each report, at 10 Hz."""

    t: float
    sequence: int
    ranges: tuple[Range, ...]


@frozen
class Pose:
    """The robot's pose, on `swarm/<robot>/dwm/pose` at 10 Hz."""

    t: float
    """The time of the pose. Of an average, the time of its measurement: a repeat of the module keeps time and
    sequence."""
    sequence: int
    """The number of the module report it comes from, as in `Ranges`."""
    x: float
    """Place in the frame of the anchors, m."""
    y: float
    heading: float | None
    """rad, counter-clockwise from x; None where the filter does not estimate it."""
    quality: int
    """Quality, 0-100; 0: there is no fix, and the other numbers must not be used."""
    source: str
    """The filter that made it: ekf, multilateration, average, module, external or recording."""
    deviation_x: float | None = None
    """Standard deviation, m; None where the filter does not estimate it."""
    deviation_y: float | None = None
    correlation: float | None = None
    """Correlation of the errors in x and y, -1 to 1."""
    deviation_heading: float | None = None
    """Standard deviation, rad; None where the heading is."""
    raw_x: float | None = None
    """The place as the module reported it, m; None without a fix."""
    raw_y: float | None = None


@frozen
class ExternalReport:
    """A pose or ranges from another process, as a motion capture system, on the key of `[dwm] source = "bus:KEY"`.

    Either `x` and `y` are there, which become `dwm/pose` as they are, or `ranges`, which go through the service's own
    calibration and filter."""

    x: Measured | None = None
    """Place in the frame of the anchors, m."""
    y: Measured | None = None
    heading: Measured | None = None
    """rad, counter-clockwise from x; None where it is not known."""
    deviation: Measured | None = None
    """Standard deviation of x and of y, m; None where it is not known."""
    ranges: dict[str, float] = field(default_factory=dict)
    """Distances, m, by the addresses of anchors."""
    age: float = 0.0
    """Seconds since it was measured, 0 to 10."""


@frozen
class Measurement:
    """Row k of a replayed recording, answered by `dwm/measurement?sequence=k`: range to target, own place."""

    t: float
    """The recording's own time since its start, s. So a row has the same answer whenever it is asked for."""
    sequence: int
    distance: float
    """Range to the target, m."""
    x: float
    """Own position, m."""
    y: float


TOPICS = with_telemetry(
    {
        ("dwm", "ranges"): Ranges,
        ("dwm", "pose"): Pose,
        ("dwm", "measurement"): Measurement,
        ("dwm", "module"): ModuleAnswer,
        ("dwm", "set/module"): ModuleRequest,
        ("dwm", "set/report"): ExternalReport,
    }
)
"""Message type of each key, by (service, topic); `*` is any one chunk."""
