"""`flood`: every robot passes on everybody's newest range and place, and solves the whole problem by itself.

Exact after as many rounds as there are hops, and what one robot knows of another is never older than that.
"""

from collections.abc import Mapping, Sequence
from math import fsum
from typing import Annotated, Any

from services.apps.builtin.localization import ranges
from services.apps.builtin.localization.leastsquares import refine
from services.apps.builtin.localization.place import UNKNOWN, Localization
from swarm import Vector, parameter
from swarm.errors import AppError
from swarm.messages.codec import Value

ROOM = 54
"""Robots there is room for: 8 bytes each in a state of at most 440."""

UNIT = 1e-3
"""m: a place and a range are sent in mm, which is what the module resolves and 1/40 of a range's noise."""

_SPAN = 1 << 17
"""The range of each of the three numbers: 51 bits, which a float64 holds. Places within 65 m of the origin, ranges
to 131 m."""
_MOST = float(_SPAN**3)
"""The largest packed number."""


class Flood(Localization):
    """Least squares of all range residuals (with equal noise the maximum-likelihood place) on every robot."""

    entries: Annotated[Vector, ROOM]
    """Range and place (`pack`) by robot, in the order of the swarm; 0 = not yet known."""
    _seen: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Range and own place, smoothed."""
    _from: tuple[str, ...] = ()
    """The neighbour on a shortest way to each robot, which knows its newest measurement."""
    _order: tuple[str, ...] = ()
    """The swarm that entries and ways are of."""

    smoothing: float = parameter(0.1, unit="1", low=0.001, high=1)
    """Share of a new measurement in range and own place."""

    def start(self) -> None:
        """Begin with the own measurement as the only one that is known."""
        robot = self.robot
        if len(robot.swarm) > ROOM:
            raise AppError(f"flood has room for {ROOM} robots, the swarm has {len(robot.swarm)}: take `info`")
        self._find_ways()
        self._seen = self.seen()
        self.entries = self._with_own((0.0,) * ROOM)

    def on_epoch(self, members: Sequence[str]) -> None:
        """Forget who is no member; find the ways anew."""
        known = dict(zip(self._order, self.entries, strict=False))
        self._find_ways()
        self.entries = tuple([known.get(name, 0.0) for name in (*self._order, *[""] * (ROOM - len(self._order)))])

    def step(self, neighbours: Sequence[Any]) -> None:
        """Take each robot's measurement from the neighbour that is nearest to it."""
        self._seen = self.smoothed(self._seen, self.smoothing)
        known = {n.name: n.entries for n in neighbours}
        entries = list(self.entries)
        for i, source in enumerate(self._from):
            if source in known:
                told = known[source][i]
                entries[i] = told if 0.0 < told <= _MOST else entries[i]
        self.entries = self._with_own(entries)

    def result(self) -> Mapping[str, Value]:
        """Place of the target, m, its uncertainty, and the other place that fits as well (the same one if none)."""
        seen = [unpack(entry) for entry in self.entries if entry]
        parts = [ranges.statistics(*one, self.sigma()) for one in seen]
        mean = tuple([fsum(column) / len(parts) for column in zip(*parts, strict=True)]) if parts else ranges.NOTHING
        found = ranges.solve(mean, len(parts)) or UNKNOWN
        place = refine(seen, (found.x, found.y)) if found.rank == 3 else (found.x, found.y)
        return self.report(place, found)

    def _find_ways(self) -> None:
        robot = self.robot
        away = {near: robot.graph.distances(near) for near in robot.neighbours}
        far = len(robot.swarm)
        self._order = robot.swarm
        self._from = tuple(
            min(robot.neighbours, key=lambda near: away[near].get(name, far), default="") for name in self._order
        )

    def _with_own(self, entries: Sequence[float]) -> tuple[float, ...]:
        own = self.robot.swarm.index(self.robot.name)
        return (*entries[:own], pack(*self._seen), *entries[own + 1 :])


def pack(distance: float, x: float, y: float) -> float:
    """Pack a range and a place, m, into a whole number that a float64 holds exactly; never 0."""
    number = 0
    for value, low in ((distance, 0), (x, -_SPAN // 2), (y, -_SPAN // 2)):
        number = number * _SPAN + min(max(round(value / UNIT) - low, 0), _SPAN - 1)
    return float(number + 1)


def unpack(entry: float) -> tuple[float, float, float]:
    """Unpack what `pack` has packed, to the mm."""
    rest, y = divmod(int(entry) - 1, _SPAN)
    distance, x = divmod(rest, _SPAN)
    return distance * UNIT, (x - _SPAN // 2) * UNIT, (y - _SPAN // 2) * UNIT
