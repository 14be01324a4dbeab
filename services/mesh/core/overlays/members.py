"""The members of the swarm, told to this robot's own bus: a while after each change of the routes, and regularly."""

from collections.abc import Callable, Collection, Mapping, Sequence

from services.mesh.core.routing.link_state import LinkStateMap
from services.mesh.core.routing.membership import SETTLE, Membership
from services.mesh.core.wire.frames import BULK
from swarm.messages import Members
from swarm.messages.codec import encode
from swarm.messages.keys import key

MEMBERS_PERIOD = 10.0
"""Seconds between two publications of `mesh/members` when nothing changes."""

_NEVER = float("inf")


class MembersWatch:
    """Looks at the routes to all robots, and tells the bus who is there."""

    def __init__(
        self,
        me: str,
        names: Sequence[str],
        membership: Membership,
        map: LinkStateMap,
        incarnation: Callable[[str], int],
        *,
        to_bus: Callable[[str, bytes, int], None],
        wanted: Callable[[str], bool],
    ) -> None:
        """`names` of all robots, sorted; `incarnation(robot)` is the newest one heard of. `to_bus(key, payload, class)`
        publishes on the own bus, and `wanted(key)` says whether anybody hears a key there."""
        self._names = names
        self._membership = membership
        self._map = map
        self._incarnation = incarnation
        self._to_bus = to_bus
        self._wanted = wanted
        self._key = key(me, "mesh", "members")
        self._look_at = _NEVER
        self._tell_at = 0.0

    def settle(self, told: Mapping[str, Collection[str]], now: float, share: float) -> None:
        """Begin with all robots here. `told` as in `Membership.look`; `share`, from 0 up to 1, is the part of a period
        after which this robot tells who is there, so that not all robots do at once."""
        self._membership.settle(told, now)
        self._look_at = self._tell_at = now + SETTLE + MEMBERS_PERIOD * share

    def routes_changed(self, now: float) -> None:
        """Look at the members `SETTLE` later, when the news of one accident have come from several robots."""
        self._look_at = min(self._look_at, now + SETTLE)

    def handle_timer(self, now: float) -> None:
        """Do everything that is due at `now`."""
        if now >= self._look_at:
            self._look_at = _NEVER
            self._look(now)
        if now >= self._tell_at:
            self._tell_at = now + MEMBERS_PERIOD
            if self._wanted(self._key):
                self._to_bus(self._key, encode(self.members(now)), BULK)

    def next_deadline(self) -> float:
        """Return the time at which `handle_timer` must be called."""
        return min(self._look_at, self._tell_at)

    def members(self, now: float) -> Members:
        """Return the message for the key `mesh/members`."""
        return Members(now, self._membership.members(), tuple(self._membership.changes))

    def _look(self, now: float) -> None:
        if self._map.undisturbed:
            return  # all are here, as `settle` was told
        incarnations = {name: self._incarnation(name) for name in self._names}
        left = [name for name in self._names if self._map.has_left(name)]
        if self._membership.look(self._map.told(), incarnations, left, now):
            self._tell_at = now
