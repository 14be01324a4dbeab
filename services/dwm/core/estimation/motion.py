"""A robot's own motion: from the balancer's sums, and where it was when a range was measured that is told only now."""

from collections import deque
from math import cos, sin
from typing import NamedTuple

from swarm.messages import Odometry

KEPT = 0.5
"""s."""

_AHEAD = 0.1
"""Longest time for which the motion is continued at its last speed, s."""


LONGEST_S = 60.0
"""Longest time between two messages from which a motion follows, s."""
MAX_SPEED, MAX_RATE = 10.0, 50.0
"""Speed (m/s) and turn rate (rad/s) that no robot has, not even one that a person carries."""
_SLACK_S = 0.1
"""Time that comes on top for these two, s: two messages may be late by different times."""


class OdometryNode(NamedTuple):
    """The robot in a frame of its own, which begins anywhere and drifts."""

    t: float
    u: float
    """m."""
    v: float
    heading: float
    """rad."""
    tilt: float
    """rad, forward positive."""


class DeadReckoning:
    """Dead reckoning from increments of way and heading."""

    def __init__(self, t: float) -> None:
        self._nodes: deque[OdometryNode] = deque([OdometryNode(t, 0.0, 0.0, 0.0, 0.0)])

    @property
    def newest(self) -> OdometryNode:
        """Return the robot's newest place."""
        return self._nodes[-1]

    def add(self, t: float, distance: float, turn: float, tilt: float) -> None:
        """`distance` (m) and `turn` (rad) were made since the newest node; t must not go back."""
        last = self._nodes[-1]
        middle = last.heading + 0.5 * turn
        node = OdometryNode(
            t, last.u + distance * cos(middle), last.v + distance * sin(middle), last.heading + turn, tilt
        )
        self._nodes.append(node)
        while len(self._nodes) > 2 and self._nodes[1].t < t - KEPT:
            self._nodes.popleft()

    def at(self, t: float) -> OdometryNode:
        """Return the robot at `t`: between nodes on a line, after the newest one on at its speed, before the first
        there."""
        nodes = self._nodes
        if t <= nodes[0].t or len(nodes) == 1:
            return nodes[0]
        after = len(nodes) - 1
        while after > 1 and nodes[after - 1].t >= t:
            after -= 1
        first, second = nodes[after - 1], nodes[after]
        if second.t <= first.t:
            return second
        share = (min(t, second.t + _AHEAD) - first.t) / (second.t - first.t)
        u, v, heading, tilt = (a + share * (b - a) for a, b in zip(first[1:], second[1:], strict=True))
        return OdometryNode(t, u, v, heading, tilt if share <= 1.0 else second.tilt)


class Increments:
    """The motion from one odometry message to the next. They hold sums: a lost one costs nothing."""

    def __init__(self) -> None:
        self._last: Odometry | None = None

    def take(self, new: Odometry) -> tuple[float, float, float, float] | None:
        """Time, way (m), turn by the gyro (rad) and tilt, for `Tracker.odometry`.

        None for the first message, for the first of a balancer that began anew and its sums with it, and for what no
        robot can do: how the robot has moved before is unknown. A message that comes twice tells of no motion.
        """
        last, self._last = self._last, new
        if last is None or (new.sequence <= last.sequence and new != last):
            return None
        way, turn = 0.5 * (new.left + new.right - last.left - last.right), new.gyro_heading - last.gyro_heading
        dt = new.t - last.t
        longest = dt + _SLACK_S
        if not 0.0 <= dt <= LONGEST_S or abs(way) > MAX_SPEED * longest or abs(turn) > MAX_RATE * longest:
            return None
        return new.t, way, turn, new.tilt
