"""Distances to other robots and to anchors, from what `dwm/ranges` of this robot and of others tell."""

from dataclasses import replace

from swarm.messages.dwm import Range, Ranges

FRESH = 1.0
"""Age in seconds beyond which a range is not used, because robots move."""


class RangeTable:
    """The newest ranges of each robot. Ages go on by the receiver's clock: the senders' clocks are their own."""

    def __init__(self, me: str) -> None:
        self._me = me
        self._newest: dict[str, tuple[Ranges, float]] = {}

    def take(self, sender: str, message: Ranges, now: float) -> None:
        """Keep the newest message of a robot, this one or another."""
        self._newest[sender] = (message, now)

    def ranges(self, now: float) -> tuple[Range, ...]:
        """This robot's ranges with their ages as they are now; none that is older than `FRESH`, or stale."""
        return self._of(self._me, now)

    def distance(self, robot: str, now: float) -> float | None:
        """Return the distance to another robot, m: the newest of what this one measured to it and it to this one."""
        found = [item for item in self._of(self._me, now) if item.robot == robot]
        found += [item for item in self._of(robot, now) if item.robot == self._me]
        return min(found, key=lambda item: item.age).distance if found else None

    def _of(self, robot: str, now: float) -> tuple[Range, ...]:
        if robot not in self._newest:
            return ()
        message, came = self._newest[robot]
        aged = (replace(item, age=item.age + now - came) for item in message.ranges)
        return tuple([item for item in aged if item.age <= FRESH and not item.stale])
