"""The path of one robot, in memory of bounded size however long the run is."""

from array import array
from bisect import bisect_left
from collections.abc import Iterator

Point = tuple[float, float]

TRACK_S = 0.1
"""Seconds between two places that are kept."""
MOST_PLACES = 4_000
"""Places that are kept, 24 bytes each: seven minutes at `TRACK_S`."""


class Track:
    """Places by time. When there are too many, each second one goes, and from then on twice the time lies between two:
    a track of a day has one each 26 s."""

    def __init__(self) -> None:
        self._times, self._x, self._y = array("d"), array("d"), array("d")
        self._every = TRACK_S

    def __len__(self) -> int:
        return len(self._times)

    def __iter__(self) -> Iterator[tuple[float, Point]]:
        """Yield times (s) and places (m), in order."""
        for t, x, y in zip(self._times, self._x, self._y, strict=True):
            yield t, (x, y)

    @property
    def begin(self) -> float:
        """Return the time of the first place, s."""
        return self._times[0]

    def add(self, t: float, place: Point) -> None:
        """Take a place, unless the one before it is too young."""
        if self._times and t < self._times[-1] + self._every - 1e-3:
            return
        if len(self._times) >= MOST_PLACES:
            self._every *= 2
            for column in (self._times, self._x, self._y):
                column[:] = column[::2]
        self._times.append(t)
        self._x.append(place[0])
        self._y.append(place[1])

    def at(self, t: float) -> Point | None:
        """Return the first place at or after a time, or the last place; None before the first one."""
        if not self._times or t < self._times[0]:
            return None
        i = min(bisect_left(self._times, t), len(self._times) - 1)
        return self._x[i], self._y[i]
