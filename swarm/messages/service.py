"""Messages of every service, and the one for all of them."""

from swarm.codec import with_telemetry
from swarm.frozen import frozen


@frozen
class Status:
    """Life cycle of a service, on `swarm/<robot>/<service>/status`: sent on change, answered to queries."""

    t: float
    service: str
    state: str
    """starting, ready, degraded or stopping."""
    reason: str
    """Why it is degraded or not yet ready; empty when ready."""
    pid: int
    since: float
    """Time of the last change of state."""
    counters: dict[str, int]
    """What was dropped, refused or retried since the start, by name."""


@frozen
class Stop:
    """On `swarm/stop`: every robot switches its motors off."""

    t: float
    origin: str
    reason: str


@frozen
class Gathered:
    """Messages of one key, on `KEY/gathered`, for who wants all of them but none at once."""

    messages: tuple[bytes, ...]
    """As they were packed, the oldest first."""


TOPICS = with_telemetry(
    {
        ("*", "status"): Status,
    }
)
"""Message type of each key, by (service, topic); `*` is any one chunk."""
