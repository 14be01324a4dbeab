"""The sorting of a module's ranges: new samples, repeats, and values that cannot be true.

The module answers whenever it is asked, but measures every 100 ms, or every 10 s while it thinks it stands still. And
it may go on naming an anchor it has lost, with the last distance.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from services.dwm.core.module.tlv import AnchorRange, Location

FORGET = 3.0
"""Seconds after which a module without a range is no longer listed, because its range says nothing about the present
place."""

STALE = 0.5
"""Seconds after which a range is marked as stale, where the module is asked 10 times a second."""

STUCK = 5
"""Answers with the very same range of one module, while others change, after which it is a repeat. With noise of 3 cm
and a resolution of 1 mm two ranges are equal once in a hundred; five in a row, never."""

MAX_DISTANCE = 100.0
"""Largest range that is accepted, m: UWB does not reach farther."""

MAX_MODULES = 64
"""The most modules that are remembered, so that wrong ones do not accumulate. Beyond that the one unseen for longest is
forgotten."""


@dataclass(slots=True)
class TrackedModule:
    """One module as it was seen last."""

    item: AnchorRange
    measured: float
    """Time of the last new sample, s."""
    sequence: int = 0
    """Number of that sample."""
    fresh: bool = True
    """Whether the newest answer brought a new sample."""
    gap: float = 0.0
    """Seconds between this sample and the one before."""
    same: int = 0


class RangeBook:
    """The modules that one robot sees. `counters` tell what was dropped."""

    def __init__(self, rate: float, robots: Mapping[str, str], *, repeats: bool = True) -> None:
        """`rate` of asking, Hz; `robots`: name of the robot that carries a module, by address. `repeats`: whether equal
        answers are one measurement; those of another source than a module are one each."""
        self.counters: Counter[str] = Counter()
        self.robots = robots
        self.stale_after = max(STALE, 2.5 / rate)
        self.tracks: dict[str, TrackedModule] = {}
        self._repeats = repeats
        self._last: Location | None = None

    def report(self, location: Location, now: float) -> bool:
        """Take an answer; False where it is the last one once more: equal in every number, position and ranges."""
        for track in self.tracks.values():
            track.fresh = False
        if self._repeats and location == self._last:
            return False
        self._last = location
        seen = Counter(item.anchor for item in location.ranges)
        for item in location.ranges:
            if seen[item.anchor] > 1:
                self.counters["duplicate_addresses"] += 1
            elif item.distance > MAX_DISTANCE:
                self.counters["impossible_ranges"] += 1
            else:
                self._sample(item, now)
        return True

    def listed(self, now: float) -> list[TrackedModule]:
        """Return the modules seen in the last seconds."""
        return [track for track in self.tracks.values() if now - track.measured <= FORGET]

    def _sample(self, item: AnchorRange, now: float) -> None:
        # Taken out and put in at the end: the first one is the longest unseen.
        track = self.tracks.pop(item.anchor, None)
        if track is None:
            track = TrackedModule(item, now)
        else:
            track.same = track.same + 1 if item == track.item else 0
            track.item = item
            if track.same < STUCK or not self._repeats:
                track.gap, track.measured, track.fresh = now - track.measured, now, True
                track.sequence += 1
        self.tracks[item.anchor] = track
        if len(self.tracks) > MAX_MODULES:
            del self.tracks[next(iter(self.tracks))]
