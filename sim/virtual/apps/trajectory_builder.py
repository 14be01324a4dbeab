"""The trajectory of one robot's app under virtual time, kept without a file."""

from array import array
from collections.abc import Mapping

from services.apps.host.observer import Source, StepRecord
from swarm.core.state import entry_names
from swarm.messages.codec import Value
from swarm.recording.trajectory import EMPTY, MOST_TIMES, Trajectory, is_kept


class TrajectoryBuilder:
    """The part of one robot's iterations that is kept: when each was done, and the states of all or of the last.

    Where not all states are kept, nor are all times of a long run: then those of two windows (`WINDOW`) in four are, of
    two in eight and so on, so that iterations can still be measured over a window.
    """

    def __init__(self, *, keep: bool) -> None:
        self._keep = keep
        self._ks, self._times = array("q"), array("d")
        """Iterations, in order, and the time of each, where not all lines are kept."""
        self._every = 2
        """Number of windows of which the first two are kept."""
        self._lines: dict[int, StepRecord] = {}
        """All lines, where they are kept."""
        self._last: StepRecord | None = None
        self._source: Source | None = None
        self._breaks: list[int] = []

    def write(self, source: Source, line: StepRecord) -> None:
        """Add one iteration."""
        self._source = source
        if self._breaks:
            line = line._replace(k=line.k + self._breaks[-1])
        self._last = line
        if self._keep:
            self._lines[line.k] = line
            return
        self._forget(line.k)
        if len(self._ks) >= MOST_TIMES:
            self._every *= 2
            kept = [(k, t) for k, t in zip(self._ks, self._times, strict=True) if is_kept(k, self._every)]
            self._ks, self._times = array("q", [k for k, _ in kept]), array("d", [t for _, t in kept])
        if is_kept(line.k, self._every):
            self._ks.append(line.k)
            self._times.append(line.t)

    def go_back(self, k: int) -> None:
        """Forget the iterations from k on, which are done again since the members have changed."""
        self._forget(k)
        for later in [other for other in self._lines if other >= k]:
            del self._lines[later]
        if self._last is not None and self._last.k >= k:
            self._last = None

    def begin_anew(self) -> None:
        """Let k go on here while the app, which has begun anew, counts from 0."""
        if self._last is not None:
            self._breaks.append(self._last.k + 1)

    def _forget(self, k: int) -> None:
        """Forget the times from iteration k on."""
        while self._ks and self._ks[-1] >= k:
            self._ks.pop()
            self._times.pop()

    def trajectory(self) -> Trajectory:
        """Return the trajectory as the recorder would have written it."""
        lines = self._lines
        if not self._keep and self._last is not None:
            lines = {self._last.k: self._last}
        if self._source is None or not lines:
            return EMPTY
        fields = self._source.runner.schema.fields
        shared = [column for field in fields for column in field.columns]
        shapes = {field.name: field.shape for field in fields} | self._source.runner.shapes
        results: list[str] = []
        for name, value in next(iter(lines.values())).result.items():
            column = f"result.{name}"
            results += entry_names(column, shapes.get(name) or (len(value),)) if isinstance(value, tuple) else [column]
        rows = {k: tuple(_cells(line.state) + _cells(line.result)) for k, line in lines.items()}
        times = {k: line.t for k, line in self._lines.items()}
        if self._last is not None and not self._keep:
            times = dict(zip(self._ks, self._times, strict=True))
            times[self._last.k] = self._last.t
        return Trajectory((*shared, *results), times, rows, tuple(self._breaks))


def _cells(values: Mapping[str, Value]) -> list[str]:
    found: list[str] = []
    for value in values.values():
        found += [str(each) if isinstance(each, str) else repr(each) for each in _parts(value)]
    return found


def _parts(value: Value) -> tuple[Value, ...]:
    return value if isinstance(value, tuple) else (value,)
