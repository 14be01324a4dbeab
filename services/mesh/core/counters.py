"""What the mesh of a robot counts."""

from services.mesh.core import overlays
from services.mesh.core.handshake import REFUSED
from services.mesh.core.session import SENT

COUNTERS = (
    *REFUSED.values(),
    *SENT,
    *overlays.COUNTERS,
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
"""Every counter; docs/frames.md and docs/overlays.md say what they count."""
