"""From a module's answer to the messages on the bus: repeats, sequence and age, calibration, filter."""

from collections import Counter
from collections.abc import Mapping

from services.dwm.core import calibration
from services.dwm.core.filters import PlaceFilter, RangeFilter
from services.dwm.core.ranges import FORGET, RangeBook, Track
from services.dwm.core.tlv import Location, Position
from swarm.config.types import Dwm
from swarm.messages import Pose, Range, Ranges


class Pipeline:
    """One robot's UWB data.

    A repeat is no new sample (`ranges`): it enters no filter and keeps its sequence; the ranges' age grows, the pose's
    `t` stays. An average starts anew after a gap of `FORGET`.
    """

    def __init__(self, settings: Dwm, robots: Mapping[str, str] | None = None) -> None:
        """`robots`: name of the robot that carries a module, by address."""
        self._settings = settings
        self._book = RangeBook(settings.rate, robots or {})
        self._distances: dict[str, tuple[RangeFilter, float]] = {}
        self._place = PlaceFilter(settings.window)
        self._fix: tuple[float, float] = (0.0, 0.0)
        self._fix_at = 0.0
        self._sequence = -1
        self._last_pose: Pose

    def dropped(self) -> Counter[str]:
        """What was dropped since the last call, by reason."""
        dropped, self._book.counters = self._book.counters, Counter()
        return dropped

    def report(self, location: Location, now: float) -> tuple[Ranges, Pose]:
        """The messages that follow from the module's answer of `now`."""
        if self._book.report(location, now):
            self._sequence += 1
            self._smooth(now)
            self._last_pose = self._pose(location.position, now)
        ranges = tuple(self._range(track, now) for track in self._book.listed(now))
        return Ranges(now, self._sequence, ranges), self._last_pose

    def _smooth(self, now: float) -> None:
        """Let new samples into their averages."""
        smoothed: dict[str, tuple[RangeFilter, float]] = {}
        for anchor, track in self._book.tracks.items():
            average, before = self._distances.get(anchor) or (RangeFilter(self._settings.window), 0.0)
            if track.fresh:
                if track.gap > FORGET:
                    average.clear()
                before = average.add(calibration.distance(self._settings.distance, track.item.distance))
            smoothed[anchor] = (average, before)
        self._distances = smoothed

    def _range(self, track: Track, now: float) -> Range:
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

    def _pose(self, place: Position, now: float) -> Pose:
        """Without quality a place is none: its numbers are old or zero and enter nothing."""
        if place.quality > 0:
            if now - self._fix_at > FORGET:
                self._place.clear()
            self._fix_at = now
            self._fix = self._place.add(*calibration.position(self._settings.position, place.x, place.y))
        source = "average" if self._settings.window > 1 else "module"
        return Pose(now, self._sequence, *self._fix, None, place.quality, source)
