"""Longest payloads, by overlay and class."""

from services.mesh.core import around, flood, unicast
from services.mesh.core.fragments import MAX_MESSAGE
from services.mesh.core.frames import BULK, FLOOD, MAX_PAYLOAD, NEIGHBOURS
from services.mesh.core.relay import AROUND


def longest(overlay: int, priority: int) -> int:
    """The longest payload of a relayed value, bytes."""
    if overlay == NEIGHBOURS:
        return MAX_MESSAGE if priority == BULK else MAX_PAYLOAD
    if overlay == AROUND:
        return around.MAX_MESSAGE
    return flood.limit_of(priority) if overlay == FLOOD else unicast.limit_of(priority)
