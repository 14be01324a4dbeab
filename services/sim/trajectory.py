"""The recordings that app hosts write as they go (one CSV line an iteration), read back and measured."""

import csv
import math
import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from swarm.errors import RecordingError

WINDOW = 10
"""Iterations of a window. On bipartite graphs (a line, an even loop) lockstep has period 2: single intervals alternate
for ever, so an iteration is measured over an even number of them, at least ten."""
WARM_UP = 10
"""Iterations left out at the start."""


@dataclass(frozen=True)
class Trajectory:
    """What one robot's app computed."""

    columns: tuple[str, ...]
    """Names of the state and result columns, without k and t."""
    times: dict[int, float]
    """Monotonic s at which state k was there."""
    rows: dict[int, tuple[str, ...]]
    """State and result of iteration k, as written (repr of the floats, so that equal text means equal bits)."""

    @property
    def last(self) -> int:
        """The last iteration; -1 where there is none."""
        return max(self.rows, default=-1)

    def value(self, k: int, column: str) -> float:
        """One number; nan where the column holds none (an absent or ambiguous result)."""
        try:
            return float(self.rows[k][self.columns.index(column)])
        except ValueError:
            return math.nan

    def first_reached(self) -> float | None:
        """When the first iteration was done."""
        return min((t for k, t in self.times.items() if k >= 1), default=None)


EMPTY = Trajectory((), {}, {})


def read(path: Path) -> Trajectory:
    """Read one recording. An unfinished last line (the robot was killed while it wrote) is left out.

    Raises `RecordingError` where one iteration stands there twice with different values: a restart forked the run.
    """
    if not path.is_file():
        return EMPTY
    text = path.read_text()
    lines = text[: text.rfind("\n") + 1].splitlines()
    if not lines:
        return EMPTY
    header, *body = csv.reader(lines)
    if header[:2] != ["k", "t"]:
        raise RecordingError(f"{path}:1: expected the columns k,t,...")
    times: dict[int, float] = {}
    rows: dict[int, tuple[str, ...]] = {}
    for number, cells in enumerate(body, 2):
        if len(cells) != len(header):
            raise RecordingError(f"{path}:{number}: {len(cells)} cells, expected {len(header)}")
        try:
            k, t = int(cells[0]), float(cells[1])
        except ValueError:
            raise RecordingError(f"{path}:{number}: k and t must be numbers") from None
        row = tuple(cells[2:])
        if rows.setdefault(k, row) != row:
            raise RecordingError(f"{path}:{number}: iteration {k} stands there twice with different values")
        times.setdefault(k, t)
    return Trajectory(tuple(header[2:]), times, rows)


def iteration_times(trajectories: Mapping[str, Trajectory]) -> list[float]:
    """Seconds an iteration of every robot, each over a window of `WINDOW`, after the warm-up."""
    return [
        (trajectory.times[k + WINDOW] - at) / WINDOW
        for trajectory in trajectories.values()
        for k, at in trajectory.times.items()
        if k >= WARM_UP and k + WINDOW in trajectory.times
    ]


def median(values: list[float]) -> float | None:
    """The median, None of nothing."""
    return statistics.median(values) if values else None


def percentile(values: list[float], percent: float) -> float | None:
    """The nearest-rank percentile, None of nothing."""
    if not values:
        return None
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, math.ceil(percent / 100 * len(ordered)) - 1)]
