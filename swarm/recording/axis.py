"""The common time axis of several robots' recordings, whose clocks began at different times and run at slightly
different rates.

Recordings of one machine since one start of it share a clock. Others are brought together by the mesh clock, whose
samples every robot records: C(t') = t' + offset + rate (t' - t), with robots of one root on one time
(`swarm.app.mesh_clock`). Where a clock has no such sample, its time of day has to do, and a note says so. A simulation
knows how its robots' clocks relate to the world's time, which then is the common time: what follows the mesh clock, as
LEDs do, would seem to be exact on an axis that follows it too.
"""

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

Axis = Callable[[float], float]
"""A function from a clock's time to the common time, s."""

WORLD = "the simulated world"
"""The root of relations to the world's time; no robot has this name."""
ONE_CLOCK, MESH_CLOCK, DAY = "one clock", "the mesh clock", "the robots' time of day"


class Relation(NamedTuple):
    """The relation of a robot's clock to the mesh clock at time t."""

    t: float
    offset: float
    rate: float
    root: str


class Clocks:
    """The clocks of a run, by id, and what is known of each."""

    def __init__(self) -> None:
        self._epochs: dict[str, float] = {}
        self._relations: dict[str, list[Relation]] = {}
        self.notes: list[str] = []
        """Doubts about the common time, in words; known after `axes`."""
        self.basis = ONE_CLOCK
        """What the common time is of: `ONE_CLOCK`, `WORLD`, `MESH_CLOCK` or `DAY`; known after `axes`."""
        self.epoch = 0.0
        """The time of day at the zero of common time, s since 1970, as well as it is known; after `axes`."""

    def add(self, clock: str, epoch: float) -> None:
        """Note a clock with the time of day at its zero, in s since 1970."""
        self._epochs.setdefault(clock, epoch)

    def relate(self, clock: str, relation: Relation) -> None:
        """Note a sample of the mesh clock that was recorded under this clock."""
        self._relations.setdefault(clock, []).append(relation)

    def axes(self) -> dict[str, Axis]:
        """Return the way from each clock to common time."""
        if len(self._epochs) < 2:
            self.epoch = next(iter(self._epochs.values()), 0.0)
            return dict.fromkeys(self._epochs, _shifted(0.0))
        counts = Counter(relation.root for each in self._relations.values() for relation in each)
        root = WORLD if WORLD in counts else min(counts, key=lambda name: (-counts[name], name), default="")
        self.basis = WORLD if root == WORLD else MESH_CLOCK if counts else DAY
        axes: dict[str, Axis] = {}
        for clock, relations in self._relations.items():
            if chosen := sorted(relation for relation in relations if relation.root == root):
                axes[clock] = _interpolated(chosen)
        # Time of day is related to common time by the clocks that have both.
        shifts = [axes[clock](0.0) - self._epochs[clock] for clock in axes if clock in self._epochs]
        shift = sorted(shifts)[len(shifts) // 2] if shifts else -min(self._epochs.values())
        self.epoch = -shift
        for clock, epoch in self._epochs.items():
            if clock not in axes:
                axes[clock] = _shifted(epoch + shift)
                self.notes.append(f"clock {clock}: no samples of the mesh clock, its time of day has to do")
        return axes


def _shifted(by: float) -> Axis:
    return lambda t: t + by


def _interpolated(relations: list[Relation]) -> Axis:
    """Between two samples the offset goes from one to the other; outside the nearest one holds with its rate."""
    times = [relation.t for relation in relations]

    def axis(t: float) -> float:
        index = bisect_right(times, t)
        if 0 < index < len(relations):
            a, b = relations[index - 1], relations[index]
            share = (t - a.t) / (b.t - a.t)
            return t + a.offset + share * (b.offset - a.offset)
        near = relations[0] if index == 0 else relations[-1]
        return t + near.offset + near.rate * (t - near.t)

    return axis
