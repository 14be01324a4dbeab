"""Neighbours that this robot is to have no link with for a while, as an operator wishes: a link that is cut on purpose.

One end suffices: it ends the connection, and refuses every new one with a reason that the other end tells. It is held
for a limited time and not through a restart, so that a robot that nobody reaches any more has its links again.
"""

import math

from swarm.messages import HoldLink

MAX_SECONDS = 600.0


class Holds:
    """Of one robot."""

    def __init__(self) -> None:
        self._until: dict[str, float] = {}

    def take(self, request: HoldLink, now: float) -> bool:
        """Begin, prolong or end (0 s) the hold of a neighbour; whether there is one now."""
        if not 0.0 < request.seconds < math.inf:
            self._until.pop(request.peer, None)
            return False
        self._until[request.peer] = now + min(request.seconds, MAX_SECONDS)
        return True

    def holds(self, peer: str, now: float) -> bool:
        """Whether there may be no link with a robot."""
        return now < self._until.get(peer, -math.inf)
