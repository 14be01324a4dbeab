"""Messages of every service, and the one for all of them."""

import math

from swarm.errors import LocalError, PayloadError
from swarm.frozen import frozen
from swarm.messages.codec import encode, unpack, with_telemetry

MAX_STOP_TEXT = 100
"""Characters of a stop's origin and reason that are kept. They come back in every state message of a balancer: others'
prose must not make those too large to send."""
MAX_REASON = 64
"""Bytes of a stop's reason that travel from robot to robot."""
MAX_STOP = 4096
"""Bytes of a stop's payload that are sent: more is only in the way of the stop."""


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
    """What was dropped, refused or retried since the start: counters by name."""


@frozen
class Stop:
    """The stop of all robots, on `swarm/stop`: each one switches its motors off."""

    t: float
    origin: str
    reason: str
    repeated: bool = False
    """Whether a mesh repeats a stop that it knows."""


def stop_of(payload: bytes) -> Stop:
    """Return the stop of a sample of `swarm/stop`, whatever its payload: that says who stops and why, never whether.

    A field that is missing or of a wrong type has a neutral value, and unknown fields (of another release) are left
    out. Never raises.
    """
    try:
        fields = unpack(payload)
    except PayloadError:
        fields = None
    if not isinstance(fields, dict):
        return Stop(0.0, "unknown", "unreadable stop message")
    t, origin, reason = (fields.get(name) for name in ("t", "origin", "reason"))
    return Stop(
        t if isinstance(t, float) and math.isfinite(t) else 0.0,
        origin[:MAX_STOP_TEXT] if isinstance(origin, str) else "unknown",
        reason[:MAX_STOP_TEXT] if isinstance(reason, str) else "",
        fields.get("repeated") is True,
    )


def short_reason(reason: str) -> str:
    """Return a stop's reason as other robots hear it."""
    return reason.encode()[:MAX_REASON].decode(errors="ignore")


def stop_payload(message: object) -> bytes:
    """Return the payload under which a stop is published; empty where `message` is too long or cannot be packed, since
    an empty payload stops, too, and an exception would not. Never raises."""
    if isinstance(message, Stop):
        origin, reason = message.origin[:MAX_STOP_TEXT], message.reason[:MAX_STOP_TEXT]
        message = Stop(message.t, origin, reason, message.repeated)
    try:
        payload = bytes(message) if isinstance(message, bytes | bytearray) else encode(message)
    except LocalError:
        return b""
    return payload if len(payload) <= MAX_STOP else b""


TOPICS = with_telemetry(
    {
        ("*", "status"): Status,
    }
)
"""Message type of each key, by (service, topic); `*` is any one chunk."""
