"""From a module's answer to the messages on the bus: repeats, sequence and age, calibration, filter."""

from dataclasses import dataclass, replace

from services.dwm.core import calibration
from services.dwm.core.filters import PlaceFilter, RangeFilter
from services.dwm.core.tlv import AnchorRange, Location, Position
from swarm.config.types import Dwm
from swarm.messages import Pose, Range, Ranges

FORGET = 3.0
"""s: an average starts anew after a longer gap; older values say nothing of where the robot is now."""

MAX_ANCHORS = 64
"""Anchors remembered, far more than any set-up has: wrong ones must not pile up. The longest unseen goes."""


@dataclass(slots=True)
class _Anchor:
    average: RangeFilter
    sequence: int = -1
    seen: float = 0.0


class Pipeline:
    """One robot's UWB data.

    A repeat is an answer equal to the one before in every number, position and ranges: with noise of
    centimetres and a resolution of millimetres two measurements do not agree in all of them by chance. It is
    no new sample: it enters no filter and keeps its sequence; the ranges' age grows, the pose's `t` stays.
    """

    def __init__(self, settings: Dwm) -> None:
        self._settings = settings
        self._anchors: dict[str, _Anchor] = {}
        self._place = PlaceFilter(settings.window)
        self._fix: tuple[float, float] = (0.0, 0.0)
        self._fix_at = 0.0
        self._last: Location | None = None
        self._measured = 0.0
        self._sequence = -1
        self._messages: tuple[Ranges, Pose]

    def report(self, location: Location, now: float) -> tuple[Ranges, Pose]:
        """The messages that follow from the module's answer of `now`."""
        if location == self._last:
            ranges, pose = self._messages
            age = now - self._measured
            return replace(ranges, t=now, ranges=tuple(replace(item, age=age) for item in ranges.ranges)), pose
        self._last = location
        self._measured = now
        self._sequence += 1
        ranges = Ranges(now, self._sequence, tuple(self._range(item, now) for item in location.ranges))
        self._messages = (ranges, self._pose(location.position, now))
        return self._messages

    def _range(self, item: AnchorRange, now: float) -> Range:
        anchor = self._anchors.pop(item.anchor, None) or _Anchor(RangeFilter(self._settings.window))
        self._anchors[item.anchor] = anchor  # at the end: the first one is the longest unseen
        if len(self._anchors) > MAX_ANCHORS:
            del self._anchors[next(iter(self._anchors))]
        if now - anchor.seen > FORGET:
            anchor.average.clear()
        anchor.seen = now
        anchor.sequence += 1
        distance = anchor.average.add(calibration.distance(self._settings.distance, item.distance))
        return Range(item.anchor, distance, item.distance, item.quality, 0.0, anchor.sequence)

    def _pose(self, place: Position, now: float) -> Pose:
        """Without quality a place is none: its numbers are old or zero and enter nothing."""
        if place.quality > 0:
            if now - self._fix_at > FORGET:
                self._place.clear()
            self._fix_at = now
            self._fix = self._place.add(*calibration.position(self._settings.position, place.x, place.y))
        source = "average" if self._settings.window > 1 else "module"
        return Pose(now, self._sequence, *self._fix, None, place.quality, source)
