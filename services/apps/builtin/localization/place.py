"""The common part of the localization algorithms: the measurement, the origin, and the quality of the place found."""

import math
from collections.abc import Mapping
from typing import ClassVar

from services.apps.builtin.localization import ranges
from services.apps.builtin.localization.ranges import Statistics, TargetEstimate
from swarm import SyncApp, float32, parameter
from swarm.messages.codec import Value

STANDS = 1e-4
"""Movement in an iteration below which a place has converged, m."""

UNKNOWN = TargetEstimate(0.0, 0.0, None, 0, (0.0, 0.0, 0.0))
"""The state before the first measurement."""


class Localization(SyncApp):
    """Base of the algorithms. Coordinates on the air are about the mean of the anchors, so that squares stay small."""

    measured: ClassVar[bool] = True
    sigma_range: float = parameter(0.04, unit="m", low=0.001)
    """Standard deviation of a range."""
    sigma_place: float = parameter(0.035, unit="m", low=0)
    """Standard deviation of the own place along the line to the target."""

    def origin(self) -> tuple[float, float]:
        """Mean of the anchors, m."""
        anchors = self.robot.anchors
        if not anchors:
            return 0.0, 0.0
        return math.fsum(a.x for a in anchors) / len(anchors), math.fsum(a.y for a in anchors) / len(anchors)

    def sigma(self) -> float:
        """Standard deviation of a range including that of the own place, m."""
        return math.hypot(self.sigma_range, self.sigma_place)

    def seen(self) -> tuple[float, float, float]:
        """Range to the target and own place about the origin, m."""
        now, (ox, oy) = self.robot.measurement, self.origin()
        return now.distance, now.x - ox, now.y - oy

    def smoothed(self, before: tuple[float, float, float], share: float) -> tuple[float, float, float]:
        """Return `seen` smoothed: what it was `before`, and this share of the way to what it is now."""
        distance, x, y = (old + share * (new - old) for old, new in zip(before, self.seen(), strict=True))
        return distance, x, y

    def statistics(self) -> Statistics:
        """Return the statistics of this step's measurement."""
        return ranges.statistics(*self.seen(), self.sigma())

    def found(self, shared: Statistics, own: Statistics) -> TargetEstimate:
        """Return the estimate from `shared`, the mean over the swarm as consensus has it; where that is no sum of
        ranges, the circle that the `own` range says."""
        return ranges.solve(shared, len(self.robot.swarm)) or ranges.solve(own, 1) or UNKNOWN

    def report(self, place: tuple[float, float], found: TargetEstimate) -> Mapping[str, Value]:
        """`place`: the target about the origin, m; `found`: what the ranges of all say about it.

        Where two places fit, the other one is that which lies farther from `place`.
        """
        ox, oy = self.origin()
        other = place
        if found.other is not None:
            other = max((found.x, found.y), found.other, key=lambda candidate: math.dist(candidate, place))
        return {
            "x": ox + place[0],
            "y": oy + place[1],
            "sigma": found.sigma,
            "var_x": found.covariance[0],
            "cov_xy": found.covariance[1],
            "var_y": found.covariance[2],
            "rank": found.rank,
            "ambiguous": found.ambiguous,
            "other_x": ox + other[0],
            "other_y": oy + other[1],
        }


class Judged(Localization):
    """Base of those whose state is a place alone: how good it is travels beside it, one of nine numbers at a time.

    The statistics of `ranges` follow their mean over the swarm by dynamic average consensus, as in `info`; iteration k
    is about number k mod 9. That is four bytes a message in place of 36.
    """

    part: float32
    """Number k mod 9 of the statistics."""
    _q: Statistics = ranges.NOTHING
    """The estimate of the mean of all nine statistics over the swarm."""
    _m: Statistics = ranges.NOTHING
    """The own statistics, smoothed."""
    _entered: Statistics = ranges.NOTHING
    """The statistics that went into `_q`."""
    _moved: float = math.inf
    """How far the place has moved in the last step, m."""

    def begin_judging(self) -> None:
        """Begin to judge; `start` calls this."""
        self._m = self._entered = self._q = self.statistics()
        self.part = self._q[0]

    def judge_anew(self) -> None:
        """Begin anew with the sum of the members' statistics; `on_epoch` calls this."""
        self._q = self._entered = self._m
        self.part = self._q[self.k % len(self._q)]

    def converged(self) -> bool:
        """Return whether the place stands still; what is shared never does, since other numbers take turns."""
        return self._moved < STANDS

    def judge(self, neighbours: list[tuple[float, float]], moved: float) -> None:
        """Compute one round of the judgement; `step` calls this. `neighbours`: Metropolis weight and `part` of each;
        `moved`: the distance by which the estimate has moved, m."""
        self._moved = moved
        smoothing = 0.1
        self._m = tuple([old + smoothing * (new - old) for old, new in zip(self._m, self.statistics(), strict=True)])
        i = self.k % len(self._q)
        pull = math.fsum(w * (part - self.part) for w, part in neighbours)
        q, entered = list(self._q), list(self._entered)
        q[i] += pull + (self._m[i] - entered[i])
        entered[i] = self._m[i]
        self._q, self._entered = tuple(q), tuple(entered)
        self.part = q[(i + 1) % len(q)]

    def judged(self) -> TargetEstimate:
        """Return the estimate from the ranges of all robots, as far as they have come here."""
        return self.found(self._q, self._m)
