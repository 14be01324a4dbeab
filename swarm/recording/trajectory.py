"""The iterations that one robot's app computed: read from a recording, compared to the bit, and timed."""

import math
import statistics
from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Any

from swarm.core.state import names_of
from swarm.errors import RecordingError
from swarm.frozen import frozen
from swarm.recording.reader import RecordingReader, shapes_of

WINDOW = 10
"""Iterations of a window. On bipartite graphs (a line, an even loop) lockstep has period 2: single intervals alternate
for ever, so an iteration is measured over an even number of them, at least ten."""
RESULT = "result."
"""How the columns of results begin."""
WARM_UP = 10
"""Iterations left out at the start."""


MOST_TIMES = 20_000
"""Iterations whose times are kept of a long run that is only measured."""
MOST_ROWS = 20_000
"""The newest iterations of such a run whose states are kept, at least; twice as many at most."""


def is_kept(k: int, every: int) -> bool:
    """Return whether the time of iteration k is kept where those of two windows in `every` are: so iterations can still
    be measured over a window."""
    return k <= WARM_UP or (k - WARM_UP) // WINDOW % every < 2


@frozen
class Trajectory:
    """The iterations that one robot's app has computed."""

    columns: tuple[str, ...] = ()
    """Names of the state and result columns: `name`, `vector[0]`, `matrix[0,0]`..., results as `result.name`."""
    times: dict[int, float] = field(default_factory=dict)
    """Seconds of the robot's clock at which state k was there."""
    rows: dict[int, tuple[str, ...]] = field(default_factory=dict)
    """State and result of iteration k, as text (repr of the floats, so that equal text means equal bits)."""
    breaks: tuple[int, ...] = ()
    """The k at which an event-driven or periodic app began anew. It counts from 0 then; here k goes on."""

    returns: tuple[int, ...] = ()
    """The k at which a synchronous app went on that had lost its state. Its k goes on with that of the others."""

    held: bool = False
    """Whether events or a clock of its own make the iterations: what they leave holds until the next one."""

    restarts: tuple[int, ...] = ()
    """The k at which a synchronous app went on whose process had ended in the midst of its steps; it kept its state."""

    @property
    def last(self) -> int:
        """The last iteration; -1 where there is none."""
        return max(self.rows, default=-1)

    @property
    def newest(self) -> float:
        """Return the time of the last iteration, s; -inf where there is none."""
        return self.times.get(self.last, -math.inf)

    def value(self, k: int, column: str) -> float:
        """Return one number; nan where the column holds none (an absent or ambiguous result). Raises
        `RecordingError` for an unknown column."""
        if column not in self.columns:
            raise RecordingError(f"there is no column {column!r}; there are: {', '.join(self.columns) or 'none'}")
        try:
            return float(self.rows[k][self.columns.index(column)])
        except ValueError:
            return math.nan

    def first_reached(self) -> float | None:
        """Return the time at which the first iteration was done."""
        return min((t for k, t in self.times.items() if k >= 1), default=None)


EMPTY = Trajectory()


class Builder:
    """Takes recorded states one by one."""

    def __init__(self, *, strict: bool = True, whole: bool = True) -> None:
        """`strict`: an iteration that stands there twice with different states is an error; else the later one counts,
        as where an app without snapshot, or a whole robot, began anew within a run. `whole`: keep all there is; else
        of a long run the newest states and some of the times."""
        self._strict = strict
        self._whole = whole
        self._every = 2
        self.forks: set[int] = set()
        """Iterations that stand there twice with different values."""
        self.shapes: Mapping[str, tuple[int, ...]] = {}
        """Rows and columns of the app's matrices, by field: messages hold them as one row after the other."""
        self._columns: tuple[str, ...] = ()
        self._times: dict[int, float] = {}
        self._rows: dict[int, tuple[str, ...]] = {}
        self._breaks: list[int] = []
        self._returns: list[int] = []
        self._restarts: list[int] = []
        self._held = False
        self._lost = False
        self._said: tuple[object, ...] = ()
        """What the app has said of its progress last, unless the members have changed since."""

    def known(self) -> Trajectory:
        """Return the trajectory so far; it grows with further messages."""
        breaks, returns, restarts = map(tuple, (self._breaks, self._returns, self._restarts))
        return Trajectory(self._columns, self._times, self._rows, breaks, returns, self._held, restarts)

    def add(self, message: Mapping[str, Any], path: Path, t: object) -> None:
        """Take the state in a message of the file `path`; `t` is its time, s.

        Raises `RecordingError` for what is no state, and for a fork of the run.
        """
        k, state, result = message.get("k"), message.get("state"), message.get("result")
        if not (isinstance(k, int) and isinstance(t, float) and isinstance(state, dict) and isinstance(result, dict)):
            raise RecordingError(f"{path}: a state without k, t, state and result")
        columns, row = self._cells(state, result)
        if not self._columns:
            self._columns = columns
        elif columns != self._columns:
            raise RecordingError(f"{path}: iteration {k} has other fields than the first: {', '.join(columns)}")
        k += self._breaks[-1] if self._breaks else 0
        if self._lost:
            self._returns.append(k)
            self._lost = False
        known = self._rows.setdefault(k, row)
        # A process that goes on from its snapshot records that state again. Its result may say of the robot, of the
        # truth or of a parameter what has changed meanwhile.
        if known is not row and self._differ(known, row):
            if self._strict:
                raise RecordingError(f"{path}: iteration {k} stands there twice with different values")
            self.forks.add(k)
            self._rows[k], self._times[k] = row, t
        self._times.setdefault(k, t)
        if not self._whole and len(self._rows) > 2 * MOST_ROWS:
            self._thin_out()

    def heed(self, topic: str, message: Mapping[str, Any]) -> None:
        """Take what an app has told beside its states: other members, that it begins anew, or has lost its state."""
        before, self._said = self._said, tuple(message.get(name) for name in ("phase", "waiting_for", "reason"))
        self._held = self._held or message.get("phase") == "starting"  # locksteps begin by running
        if topic.endswith("/epoch"):
            self._said = ()
            self.go_back(message)
        elif before == self._said and before[0] == "running" and self._rows:
            self._restarts.append(max(self._rows) + 1)  # it says the same again only when it was started anew
        elif message.get("phase") == "starting" and self._rows:
            self._breaks.append(max(self._rows) + 1)
        elif message.get("phase") == "waiting" and message.get("k") == 0 and max(self._rows, default=0) > 0:
            self._lost = True

    def _cells(self, state: Mapping[str, Any], result: Mapping[str, Any]) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the columns of a message and their cells."""
        columns: list[str] = []
        row: list[str] = []
        for prefix, values in (("", state), (RESULT, result)):
            for name, value in values.items():
                if isinstance(value, tuple):
                    columns += names_of(prefix + name, len(value), self.shapes.get(name, ()))
                    row += map(_text, value)
                else:
                    columns.append(prefix + name)
                    row.append(_text(value))
        return tuple(columns), tuple(row)

    def _differ(self, known: tuple[str, ...], row: tuple[str, ...]) -> bool:
        """Return whether two rows have different states."""
        cells = zip(self._columns, known, row, strict=True)
        return any(a != b for name, a, b in cells if not name.startswith(RESULT))

    def _thin_out(self) -> None:
        newest = sorted(self._rows)[-MOST_ROWS:]
        self._rows = {k: self._rows[k] for k in newest}
        while sum(1 for k in self._times if is_kept(k, self._every)) > MOST_TIMES:
            self._every *= 2
        self._times = {k: t for k, t in self._times.items() if is_kept(k, self._every) or k >= newest[0]}

    def go_back(self, epoch: Mapping[str, Any]) -> None:
        """The members have changed: the iterations from the epoch's first one on are done again."""
        k = epoch.get("k")
        if isinstance(k, int):
            for kept in (self._rows, self._times):
                for later in [other for other in kept if other >= k]:
                    del kept[later]


class TrajectoryReader:
    """Reads one app's trajectory from a recording, and goes on with it while the file grows."""

    def __init__(self, path: Path, *, whole: bool = True) -> None:
        """`whole`: see `Builder`."""
        self._path = path
        self._topic = ""
        """The topic of the states of the first app in the file."""
        self._reader: RecordingReader | None = None
        self._builder = Builder(whole=whole)
        self._shaped = False

    def read(self) -> Trajectory:
        """Return the trajectory so far; empty where there is no such file. Raises `RecordingError`."""
        if self._reader is None:
            if not self._path.is_file() or not self._path.stat().st_size:
                return EMPTY
            self._reader = RecordingReader(self._path)
        for sample in self._reader.samples(_tells):
            if not self._topic and is_state(sample.topic):
                self._topic = sample.topic
            if sample.topic == self._topic:
                if not self._shaped:  # the recorder writes those of results before the first state
                    self._shaped = True
                    self._builder.shapes = shapes_of(self._reader.metadata)
                message = sample.message
                self._builder.add(message, self._path, message.get("t"))
            elif sample.topic in beside(self._topic):
                self._builder.heed(sample.topic, sample.message)
        return self._builder.known()


def read(path: Path, *, whole: bool = True) -> Trajectory:
    """Read one recording of one app. What was cut off (the robot was killed while it wrote) is left out. `whole`: see
    `Builder`."""
    return TrajectoryReader(path, whole=whole).read()


def is_state(topic: str) -> bool:
    """Return whether an app's states travel under this topic."""
    chunks = topic.split("/")
    return len(chunks) in (5, 6) and chunks[2] == "app" and chunks[-1] == "state"


def _tells(topic: str) -> bool:
    """Return whether it may be what an app tells of itself: its progress comes before its first state."""
    return is_state(topic) or topic.endswith(("/epoch", "/progress"))


def beside(states: str) -> tuple[str, str]:
    """Return the topics of an app's changes of members and of its progress, by that of its states: see
    `Builder.heed`."""
    prefix = states.removesuffix("state")
    return prefix + "epoch", prefix + "progress"


def _text(value: object) -> str:
    return value if isinstance(value, str) else "nan" if value is None else repr(value)


def iteration_times(trajectories: Mapping[str, Trajectory]) -> list[float]:
    """Return how many seconds iterations of all robots took after the warm-up: means over windows of `WINDOW`."""
    return [
        (trajectory.times[k + WINDOW] - at) / WINDOW
        for trajectory in trajectories.values()
        for k, at in trajectory.times.items()
        if k >= WARM_UP and k + WINDOW in trajectory.times
    ]


def median(values: list[float]) -> float | None:
    """Return the median; None where there are no values."""
    return statistics.median(values) if values else None
