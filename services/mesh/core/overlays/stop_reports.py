"""Tells this robot's bus, and the swarm, which robots have stopped the swarm."""

import itertools
from collections.abc import Callable

from services.mesh.core.overlays.flood import Flood
from services.mesh.core.overlays.stop_register import Register
from services.mesh.core.wire.frames import BULK, CONTROL
from swarm.messages import Stop, Stopped
from swarm.messages.codec import encode
from swarm.messages.keys import STOP, key

STOP_PERIOD = 1.0
"""s between two repetitions of `swarm/stop` on the own bus while the swarm is stopped: a service that starts, or a
message that was lost, must not make an exception."""

CONFIRM_AFTER = 0.05
"""s from a change of the register until `mesh/stopped` is flooded: stops that are given on many robots at once make one
flood of each robot."""

MAX_NAMED = 16
"""Robots that `mesh/stopped` names: with their reasons it stays far below what a flood carries."""

_NEVER = float("inf")


class Stops:
    """Watches the register."""

    def __init__(self, me: str, register: Register, flood: Flood, to_bus: Callable[[str, bytes, int], None]) -> None:
        """`to_bus(key, payload, class)` publishes on the own bus."""
        self._register = register
        self._flood = flood
        self._to_bus = to_bus
        self._key = key(me, "mesh", "stopped")
        self._confirmed: dict[str, str] = {}
        self._tell_at = _NEVER
        self._confirm_at = _NEVER

    def changed(self, now: float) -> None:
        """The register has changed."""
        self._tell(now)
        if self._tell_at == _NEVER:
            self._to_bus(self._key, encode(self.stopped(now)), CONTROL)
        self._confirm_at = min(self._confirm_at, now + CONFIRM_AFTER)

    def handle_timer(self, now: float) -> None:
        """Whatever is due."""
        if now >= self._tell_at:
            self._tell(now)
        if now >= self._confirm_at:
            self._confirm_at = _NEVER
            if self._confirmed != (stops := self._register.stops):
                self._confirmed = stops
                # To all robots, and not in the control class, where the stops themselves are.
                self._flood.publish(self._key, encode(self.stopped(now)), BULK, now, latest=True)

    def next_deadline(self) -> float:
        """When `handle_timer` wants to be called."""
        return min(self._tell_at, self._confirm_at)

    def stopped(self, now: float) -> Stopped:
        """For the key `mesh/stopped`."""
        stops = self._register.stops
        return Stopped(now, bool(stops), dict(itertools.islice(stops.items(), MAX_NAMED)))

    def _tell(self, now: float) -> None:
        stops = self._register.stops
        self._tell_at = now + STOP_PERIOD if stops else _NEVER
        if stops:
            self._to_bus(self._key, encode(self.stopped(now)), CONTROL)
        for origin, reason in stops.items():
            self._to_bus(STOP, encode(Stop(now, origin, reason)), CONTROL)
