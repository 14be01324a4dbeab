"""The way from a module's answers to the messages on the bus: repeats, sequence and age, calibration, filter, pose."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import sqrt

from services.dwm.core.calibration import models
from services.dwm.core.estimation.ekf import EkfNoise
from services.dwm.core.estimation.filters import PlaceFilter, RangeFilter
from services.dwm.core.estimation.multilateration import NoFix, multilaterate
from services.dwm.core.estimation.tracker import Tracker
from services.dwm.core.module.ranges import FORGET, RangeBook, TrackedModule
from services.dwm.core.module.tlv import Location, Position
from swarm.config.types import Anchor, Dwm
from swarm.messages import Pose, Range, Ranges

_GOOD = 0.05
"""Largest standard deviation of a place with quality 100, m."""


class Pipeline:
    """One robot's UWB data.

    A repeat is no new sample (`ranges`): it enters no filter and keeps its sequence; the ranges' age grows, and the `t`
    of a pose that is an average stays. An average starts anew after a gap of `FORGET`.
    """

    def __init__(
        self,
        settings: Dwm,
        robots: Mapping[str, str] | None = None,
        *,
        kind: str = "average",
        calibration: models.Calibration | None = None,
        anchors: Sequence[Anchor] = (),
        external: bool = False,
    ) -> None:
        """`robots`: name of the robot that carries a module, by address. `kind` of filter, as in `Dwm.filter`.
        `external`: the ranges are no module's, each report is a measurement, and its time is known."""
        self._settings = settings
        self._kind = kind
        self._models = calibration or models.Calibration(models.RangeModel.of(settings.distance), settings.position)
        self._anchors = {anchor.address: (anchor.x, anchor.y, anchor.z) for anchor in anchors}
        self._book = RangeBook(settings.rate, robots or {}, repeats=not external)
        self._distances: dict[str, tuple[RangeFilter, float]] = {}
        self._place = PlaceFilter(settings.position_window or settings.window)
        self._fix: tuple[float, float] = (0.0, 0.0)
        self._fix_at = 0.0
        self._sequence = -1
        self._last_pose: Pose
        self.tracker = Tracker(
            self._anchors,
            settings.height,
            latency=0.0 if external else settings.latency,
            lever=settings.lever,
            antenna=self._models.ranges.antenna,
        )
        """The tracker of the pose, which gets the odometry; it is idle without odometry."""

    def dropped(self) -> Counter[str]:
        """Return the counters of what was dropped since the last call, by reason."""
        dropped, self._book.counters = self._book.counters, Counter()
        return dropped

    def report(self, location: Location, now: float) -> tuple[Ranges, Pose]:
        """Return the messages that follow from the module's answer of `now`."""
        if self._book.report(location, now):
            self._sequence += 1
            self._smooth(now)
            fresh = [
                (name, self._models.ranges.distance(track.item.distance))
                for name, track in self._book.tracks.items()
                if track.fresh
            ]
            if self._kind == "multilateration":
                self._last_pose = self._multilaterated(fresh, now)
            else:
                self._last_pose = self._averaged(location.position, now)
                self.tracker.ranges(now, fresh)
        ranges = tuple([self._range(track, now) for track in self._book.listed(now)])
        pose = self._tracked(now) if self._kind in ("ekf", "auto") else self._last_pose
        if location.position.quality > 0:
            pose = replace(pose, raw_x=location.position.x, raw_y=location.position.y)
        return Ranges(now, self._sequence, ranges), pose

    def _smooth(self, now: float) -> None:
        """Let new samples into their averages."""
        smoothed: dict[str, tuple[RangeFilter, float]] = {}
        for anchor, track in self._book.tracks.items():
            average, before = self._distances.get(anchor) or (RangeFilter(self._settings.window), 0.0)
            if track.fresh:
                if track.gap > FORGET:
                    average.clear()
                before = average.add(self._models.ranges.distance(track.item.distance))
            smoothed[anchor] = (average, before)
        self._distances = smoothed

    def _range(self, track: TrackedModule, now: float) -> Range:
        item, age = track.item, now - track.measured
        return Range(
            anchor=item.anchor,
            distance=self._distances[item.anchor][1],
            raw=item.distance,
            quality=item.quality,
            age=age,
            sequence=track.sequence,
            stale=age > self._book.stale_after,
            robot=self._book.robots.get(item.anchor),
        )

    def _averaged(self, place: Position, now: float) -> Pose:
        """Return the average of places. A place of quality 0 is left out: its numbers are old or zero."""
        if place.quality > 0:
            self._smooth_place(*models.position(self._models.position, place.x, place.y), now)
        source = "average" if (self._settings.position_window or self._settings.window) > 1 else "module"
        return Pose(now, self._sequence, *self._fix, None, place.quality, source)

    def _multilaterated(self, ranges: Sequence[tuple[str, float]], now: float) -> Pose:
        """Return the pose from ranges to configured anchors, smoothed like the module's own places."""
        heard = [(self._anchors[name], distance) for name, distance in ranges if name in self._anchors]
        fix = multilaterate(
            [place for place, _ in heard], [d for _, d in heard], self._settings.height, EkfNoise().range
        )
        if isinstance(fix, NoFix):
            return Pose(now, self._sequence, *self._fix, None, 0, "multilateration")
        self._smooth_place(fix.x, fix.y, now)
        pose = Pose(now, self._sequence, *self._fix, None, 0, "multilateration")
        return _with_covariance(pose, fix.covariance)

    def _smooth_place(self, x: float, y: float, now: float) -> None:
        if now - self._fix_at > FORGET:
            self._place.clear()
        self._fix_at = now
        self._fix = self._place.add(x, y)

    def _tracked(self, now: float) -> Pose:
        """Return the Kalman filter's, for the moment; while it has none, the average's, or none where `ekf` was asked
        for."""
        estimate = self.tracker.estimate(now) if self.tracker.has_odometry(now) else None
        if estimate is not None:
            pose = Pose(now, self._sequence, estimate.x, estimate.y, estimate.heading, 0, "ekf")
            pose = replace(pose, deviation_heading=estimate.heading_deviation)
            return _with_covariance(pose, estimate.covariance)
        if self._kind == "ekf":
            return Pose(now, self._sequence, *self._fix, None, 0, "ekf")
        return self._last_pose


def _with_covariance(pose: Pose, covariance: tuple[float, float, float]) -> Pose:
    """Return the pose with the deviations of its place, and a quality that says as much in one number."""
    xx, xy, yy = covariance
    quality = max(1, round(100 * min(1.0, _GOOD / sqrt(max(xx, yy)))))
    return replace(pose, quality=quality, deviation_x=sqrt(xx), deviation_y=sqrt(yy), correlation=xy / sqrt(xx * yy))
