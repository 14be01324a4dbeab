"""The record of the simulated robots as seen from outside: their LEDs, their places, and who stands when.

Fed with true poses and changes of the LEDs' registers; no app and no robot knows of it.
"""

import math
from array import array
from bisect import bisect_left
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple

from services.balancer.core.control.estimation.posture import UPRIGHT
from sim.core.track import Point, Track
from swarm.core.percentile import percentile

MOST_FLASHES = 20_000
"""Times of flashes that are kept of a robot: the first ones, three hours at two a second. A flash behind them is
counted."""
STANDS_S = 0.5
"""Seconds upright from which on a robot counts as standing and not as swinging through."""


class Phases(NamedTuple):
    """The differences of the times at which LEDs went on, s; 95 % of all differences are at most that."""

    neighbours: float
    all: float
    synchronous_at: float | None
    """The time from which on no two LEDs were more than SYNCHRONOUS_S apart throughout WINDOW_S; None: never."""


SYNCHRONOUS_S = 0.02
WINDOW_S = 3.0
"""Seconds in which each LED must go on at least twice."""


class SceneRecord:
    """Keeps what it sees, in bounded memory. Times are of one clock, s."""

    def __init__(self, names: Iterable[str]) -> None:
        self.names = tuple(names)
        self.tracks = {name: Track() for name in self.names}
        """The places of each robot over time."""
        self.flashes = {name: array("d") for name in self.names}
        """The times at which each robot's yellow LED went on, the first MOST_FLASHES ones."""
        self.flashed = dict.fromkeys(self.names, 0)
        """The number of times that each robot's yellow LED went on."""
        self.stood_at: dict[str, float] = {}
        """The time since which each robot stands; a robot that does not stand is missing."""
        self._upright: dict[str, float] = {}
        self._yellow = dict.fromkeys(self.names, False)

    def pose(self, robot: str, t: float, place: Point, tilt: float) -> None:
        """Record a robot's true place (m) and tilt (rad)."""
        self.tracks[robot].add(t, place)
        if abs(tilt) > UPRIGHT:
            self._upright.pop(robot, None)
            self.stood_at.pop(robot, None)
        elif t - self._upright.setdefault(robot, t) >= STANDS_S:
            self.stood_at.setdefault(robot, self._upright[robot])

    def leds(self, robot: str, t: float, *, yellow: bool) -> None:
        """Record a change of a robot's LEDs."""
        if yellow and not self._yellow[robot]:
            self.flashed[robot] += 1
            if len(self.flashes[robot]) < MOST_FLASHES:
                self.flashes[robot].append(t)
        self._yellow[robot] = yellow

    def place(self, robot: str, t: float) -> Point | None:
        """Return a robot's place at a time; None before it was seen."""
        return self.tracks[robot].at(t)

    def phases(self, edges: Collection[tuple[str, str]], since: float) -> Phases | None:
        """Return the differences of the times at which the robots' LEDs went on, from `since` on. `edges`: the pairs
        of neighbours. None where an LED never went on."""
        if not all(times and times[-1] >= since for times in self.flashes.values()):
            return None
        end = min(times[-1] for times in self.flashes.values())
        near: list[float] = []
        every: list[float] = []
        for i, a in enumerate(self.names):
            for b in self.names[:i]:
                apart = [_nearest(self.flashes[b], t) for t in self.flashes[a] if since <= t <= end]
                every += apart
                if (a, b) in edges or (b, a) in edges:
                    near += apart
        return Phases(percentile(near, 95), percentile(every, 95), self._synchronous(since))

    def _synchronous(self, since: float) -> float | None:
        """Return the time of the first flash after which all LEDs went on together throughout `WINDOW_S`; None without
        one."""
        end = min(times[-1] for times in self.flashes.values()) - WINDOW_S
        for begin in sorted({t for times in self.flashes.values() for t in times if since <= t <= end}):
            windows = {
                name: times[bisect_left(times, begin) : bisect_left(times, begin + WINDOW_S)]
                for name, times in self.flashes.items()
            }
            if all(len(times) >= 2 for times in windows.values()) and all(
                _nearest(self.flashes[b], t) <= SYNCHRONOUS_S
                for a in self.names
                for b in self.names
                for t in windows[a]
            ):
                return begin
        return None

    def misfits(self, offsets: Mapping[str, Point]) -> list[tuple[float, float]]:
        """Return times, and how far the robots are then from the shape with these places (root mean square, m),
        wherever the shape is."""
        if not all(self.tracks.values()):
            return []
        begin = max(track.begin for track in self.tracks.values())
        found = []
        for t, _ in self.tracks[self.names[0]]:
            if t < begin:
                continue
            origins = [
                (place[0] - offsets[name][0], place[1] - offsets[name][1])
                for name in self.names
                if (place := self.place(name, t)) is not None
            ]
            x, y = (math.fsum(axis) / len(origins) for axis in zip(*origins, strict=True))
            found.append((t, math.sqrt(math.fsum((p - x) ** 2 + (q - y) ** 2 for p, q in origins) / len(origins))))
        return found


def _nearest(times: Sequence[float], t: float) -> float:
    """Return the distance from `t` to the nearest of `times` (sorted, at least one)."""
    at = bisect_left(times, t)
    return min(abs(times[i] - t) for i in (at - 1, at) if 0 <= i < len(times))
