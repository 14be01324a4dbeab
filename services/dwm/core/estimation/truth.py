"""The errors of poses and ranges against a truth that another source measures, such as motion capture; no IO."""

import math
from bisect import bisect_left
from collections import defaultdict
from statistics import fmean, pstdev
from typing import Any

from services.dwm.core.calibration.samples import Point3
from services.dwm.core.estimation.filters import Place
from swarm.messages import Pose, Ranges

GAP_S = 0.3
"""Longest time between two reports of the truth that are joined, s. In a longer gap the truth is unknown."""


class TruthComparison:
    """Gathers what is heard; `result` compares it. Times are those of one clock, s."""

    def __init__(self, anchors: dict[str, Point3]) -> None:
        """`anchors`: places by address, m, heights over the robot's antenna."""
        self._anchors = anchors
        self._truth: list[tuple[float, float, float]] = []
        self._poses: dict[int, tuple[float, float, float]] = {}
        self._ranges: dict[tuple[str, int], tuple[float, float]] = {}

    def truth(self, t: float, x: float, y: float) -> None:
        """Take a true place (m) of this time; one that is older than the last is left out."""
        if not self._truth or t > self._truth[-1][0]:
            self._truth.append((t, x, y))

    def pose(self, message: Pose) -> None:
        """Take a pose that is a fix."""
        if message.quality > 0:
            self._poses[message.sequence] = message.t, message.x, message.y

    def ranges(self, message: Ranges) -> None:
        """Take new ranges to anchors of the configuration."""
        for each in message.ranges:
            if each.anchor in self._anchors and not each.stale:
                self._ranges.setdefault((each.anchor, each.sequence), (message.t - each.age, each.distance))

    def result(self) -> dict[str, Any]:
        """Return errors in m: of poses, and by anchor of the calibrated ranges; None where nothing can be compared."""
        errors = []
        for t, x, y in self._poses.values():
            if (place := self._at(t)) is not None:
                errors.append((x - place[0], y - place[1]))
        by_anchor: defaultdict[str, list[float]] = defaultdict(list)
        for (name, _), (t, distance) in self._ranges.items():
            if (place := self._at(t)) is not None:
                by_anchor[name].append(distance - math.dist((*place, 0.0), self._anchors[name]))
        return {
            "truths": len(self._truth),
            "pose": _of_places(errors) if errors else None,
            "ranges": {
                name: {"count": len(row), "mean_m": round(fmean(row), 4), "deviation_m": round(pstdev(row), 4)}
                for name, row in sorted(by_anchor.items())
            },
        }

    def _at(self, t: float) -> Place | None:
        """Return the true place at a time between two reports that are near enough; None elsewhere."""
        index = bisect_left(self._truth, (t,))
        if not 0 < index < len(self._truth):
            return None
        (t0, x0, y0), (t1, x1, y1) = self._truth[index - 1 : index + 1]
        if t1 - t0 > GAP_S:
            return None
        share = (t - t0) / (t1 - t0)
        return x0 + share * (x1 - x0), y0 + share * (y1 - y0)


def _of_places(errors: list[tuple[float, float]]) -> dict[str, Any]:
    lengths = sorted(math.hypot(*error) for error in errors)
    mean_x, mean_y = (fmean(column) for column in zip(*errors, strict=True))
    return {
        "count": len(errors),
        "rms_m": round(math.sqrt(fmean(length**2 for length in lengths)), 4),
        "p90_m": round(lengths[math.ceil(0.9 * len(lengths)) - 1], 4),
        "mean_m": [round(mean_x, 4), round(mean_y, 4)],
    }
