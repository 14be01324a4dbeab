"""Messages of the simulated world."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Truth:
    """True pose of a simulated robot, on `swarm/<robot>/sim/truth` at 10 Hz."""

    t: float
    x: float
    y: float
    heading: float
    tilt: float


TOPICS: dict[tuple[str, str], type] = {
    ("sim", "truth"): Truth,
}
"""Message type of each key, by (service, topic); `*` is any one chunk."""
