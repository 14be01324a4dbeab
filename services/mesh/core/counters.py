"""What the mesh of a robot counts."""

from services.mesh.core.link.handshake import REFUSED
from services.mesh.core.link.session import SENT
from services.mesh.core.overlays import robot_overlays

COUNTERS = (
    *REFUSED.values(),
    *SENT,
    *robot_overlays.COUNTERS,
    "byes",
    "half_open",
    "inbound_refused",
    "incomplete",
    "no_link",
    "overflowed",
    "pushed_back",
    "replaced",
    "too_large",
    "transport_lost",
)
"""Every counter; docs/frames.md and docs/robot_overlays.md say what they count."""
