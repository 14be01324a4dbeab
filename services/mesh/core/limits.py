"""Longest payloads, by overlay and class."""

from services.mesh.core.overlays import flood, unicast
from services.mesh.core.wire.fragments import MAX_MESSAGE
from services.mesh.core.wire.frames import BULK, FLOOD, MAX_PAYLOAD, NEIGHBOURS


def longest(overlay: int, priority: int) -> int:
    """The longest payload of a relayed value, bytes."""
    if overlay == NEIGHBOURS:
        return MAX_MESSAGE if priority == BULK else MAX_PAYLOAD
    return flood.limit_of(priority) if overlay == FLOOD else unicast.limit_of(priority)
