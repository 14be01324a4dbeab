"""A run as arrays: of a simulation that `simulate` has computed, or of a recording, be it of real robots."""

import json
import shutil
import warnings
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swarm import config as configuration
from swarm.core.state import entry_names
from swarm.errors import LocalError, MissingPackageError, RecordingError
from swarm.process.arguments import PICTURES
from swarm.recording import folder
from swarm.recording.reader import OUTCOME
from swarm.recording.run import Run
from swarm.recording.trajectory import Trajectory

try:
    import numpy as np
except ImportError:
    raise MissingPackageError("a run", "numpy", "lab") from None

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

RESULT = "result."

Array = np.ndarray[Any, np.dtype[Any]]


class RunData:
    """One run as numpy arrays.

    Arrays have the axes iteration (from 0 on) and robot (in the order of `robots`), and further ones for a vector or
    matrix. If a robot has no such iteration, its entry is nan, or None in an array of texts."""

    def __init__(self, path: Path, app: str = "") -> None:
        """`path`: the run's folder, or one recording of it; `app`: which one is looked at where robots ran several.
        Raises `RecordingError` where there is no recording."""
        self.path = path
        self.recording = Run(path, app)
        """The whole recording, for example `recording.samples("swarm/*/dwm/pose")`."""
        self.app = self.recording.app
        """The app's name."""

    # -- what there is

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robots: the second axis of all arrays."""
        return tuple(next(iter(self._trajectories.values())))

    @property
    def columns(self) -> tuple[str, ...]:
        """Names that `run[...]` takes: shared states, then further results of the app. A vector has one name, and a
        field of a channel is `channel.name`."""
        return tuple(self._columns)

    @property
    def iterations(self) -> int:
        """The last iteration that a robot has done."""
        return len(self.times) - 1

    @cached_property
    def times(self) -> Array:
        """Time at which each robot had each state, s after the first one; float of shape (iteration, robot)."""
        return _times(self._trajectories.get("", {}))

    @property
    def messages(self) -> int | None:
        """Number of states, and of acknowledgements of messages, that all robots have sent, counted once for each
        neighbour. What `flood` and `send` carry is not in it: `recording.samples("swarm/*/app/*/asked")` has that.

        None for recordings without this number, such as those of real robots."""
        return int(self._outcome["messages"]) if "messages" in self._outcome else None

    @property
    def problems(self) -> tuple[str, ...]:
        """Problems of the run, such as an app in fault or a minute without an iteration, and damage of its recording;
        empty if there was none."""
        return (*json.loads(self._outcome.get("problems", "[]")), *self.recording.damage)

    @property
    def never(self) -> tuple[str, ...]:
        """Faults that were planned and did not happen, because the run ended before."""
        return tuple(json.loads(self._outcome.get("never", "[]")))

    @property
    def closest(self) -> float | None:
        """The smallest distance between two simulated robots, m between their axles; they touch at 0.15. None for one
        robot, and for real robots."""
        return self._scene.get("closest_m")

    @property
    def contacts(self) -> int | None:
        """The number of times that two simulated robots have touched; None as for `closest`."""
        return self._scene.get("contacts")

    @cached_property
    def truth(self) -> Array | None:
        """True places of the simulated robots when they reached each state: x, y in m and heading in rad.

        The array has floats of shape (iteration, robot, 3), interpolated between the world's samples (5 a second). None
        for real robots."""
        return self._along("truth", ("x", "y", "heading"))

    @cached_property
    def target(self) -> Array | None:
        """Return the place of the simulated target, m: float of shape (iteration, robot, 2); None for real robots."""
        moving = self._along("target", ("x", "y"))
        file = self.path / folder.CONFIG_FILE
        if moving is not None or self.truth is None or not file.is_file():
            return moving
        target = configuration.load(file).simulation.target
        return np.where(np.isnan(self.times)[..., None], np.nan, np.array(target))

    # -- arrays

    def __getitem__(self, name: str) -> Array:
        """Return a state or a result by name: of shape (iteration, robot), of a vector of n (iteration, robot, n),
        of a matrix (iteration, robot, n, m). The type is float64; bool and int64 as long as no entry is missing, since
        numpy's have no nan: `x = run["n"][:, 0]; x[~np.isnan(x)].astype(int)` are those of the first robot in any
        case. Texts (and members of an enum, by name) are objects. Raises `LocalError` with the names that there are."""
        if name not in self._columns:
            raise self._unknown(name)
        channel, places = self._columns[name]
        paths = self._trajectories[channel]
        parts = [_array(paths, place) for place in places]
        if "[" not in places[0]:
            return parts[0]
        stacked = np.stack(parts, axis=-1)
        return stacked.reshape(*stacked.shape[:2], *self.recording.shapes.get(name, (-1,)))

    def __contains__(self, name: str) -> bool:
        return name in self._columns

    def to_pandas(self) -> "pd.DataFrame":
        """Return a table with a row for each iteration and robot: `iteration`, `robot`, `t`, and the app's columns,
        a vector's entries as `x[0]`, `x[1]`..., a matrix's as `P[0,0]`, `P[0,1]`... A state that is called `t` or
        `iteration` has the column `app.t` or `app.iteration`. Needs pandas, of the extra `notebook`."""
        k, robot = np.nonzero(~np.isnan(self.times))
        table: dict[str, Any] = {
            "iteration": k,
            "robot": np.array(self.robots)[robot],
            "t": self.times[k, robot],
        }
        for name in (name for name in self.columns if not self._columns[name][0]):
            values = self[name][k, robot]
            if values.ndim == 1:
                table[f"app.{name}" if name in table else name] = values
                continue
            shape = values.shape[1:]
            for entry, place in zip(entry_names(name, shape), np.ndindex(*shape), strict=True):
                table[entry] = values[(slice(None), *place)]
        return table_of(table)

    def plot(self, *columns: str, kind: str | None = None, path: str | Path | None = None) -> "Figure":
        """Draw the run as `swarm plot` does: these columns, or entries as "P[0,0]", over iterations and time, or a
        picture of this kind (by default what suits the app). Returns the figure, which a notebook shows; with `path` it
        is a file, too."""
        from laptop.cli.runs.plot import draw_on
        from laptop.plotting import style

        wanted = [part for name in columns for part in self._parts(name)]
        with style.figure(path, settings=style.RC, in_notebook=True, layout="constrained") as figure:
            draw_on(figure, self.recording, kind, wanted)
        return figure

    def save(self, path: str | Path) -> None:
        """Write the recording to a new folder, which `swarm.load`, `swarm plot` and `swarm replay` read."""
        place = Path(path)
        if place.exists() and (not place.is_dir() or any(place.iterdir())):
            raise LocalError(f"{place}: it is there already; name a new folder")
        try:
            if self.path.is_dir():
                shutil.copytree(self.path, place, dirs_exist_ok=True)
            else:
                place.mkdir(parents=True, exist_ok=True)
                shutil.copy2(self.path, place)
        except OSError as error:
            raise LocalError(f"{place}: the run cannot be saved there: {error.strerror or error}") from None

    def __repr__(self) -> str:
        problems = f", problems: {'; '.join(self.problems)}" if self.problems else ""
        if not self.recording.states():
            return f"<run of {self.app or 'no app'} without states{problems}>"
        return (
            f"<run of {self.app}: {len(self.robots)} robots, {self.iterations} iterations; "
            f"{', '.join(self.columns)}{problems}>"
        )

    # -- inside

    @cached_property
    def _outcome(self) -> Mapping[str, str]:
        notes = self.recording.notes(OUTCOME)
        return notes[-1] if notes else folder.read_outcome(self.path)

    @cached_property
    def _scene(self) -> Mapping[str, Any]:
        found: Mapping[str, Any] = json.loads(self._outcome.get("scene", "{}"))
        return found

    @cached_property
    def _trajectories(self) -> dict[str, dict[str, Trajectory]]:
        """Return the trajectories by channel (the app itself is empty) and robot."""
        found = {channel: self.recording.trajectories(channel=channel) for channel in self.recording.states()}
        if not found:
            why = "".join(f"; {problem}" for problem in self.problems)
            raise RecordingError(f"{self.path}: no app's states are recorded{why}")
        return found

    @cached_property
    def _columns(self) -> dict[str, tuple[str, list[str]]]:
        """Return by each name that can be asked for: its channel, and the columns that belong to it."""
        found: dict[str, tuple[str, list[str]]] = {}
        for channel, paths in self._trajectories.items():
            names = next((path.columns for path in paths.values() if path.columns), ())
            prefix = f"{channel}." if channel else ""
            for results in (False, True):
                for column in (each for each in names if each.startswith(RESULT) == results):
                    name = prefix + column.removeprefix(RESULT).partition("[")[0]
                    known = found.setdefault(name, (channel, []))[1]
                    if not known or known[0].startswith(RESULT) == results:  # a state goes before a result of its name
                        known.append(column)
        return found

    def _parts(self, name: str) -> list[str]:
        """Return the columns of the recording that a name, or that of an entry, means; raises `LocalError`."""
        channel, places = self._columns.get(name) or self._columns.get(name.partition("[")[0]) or ("", [])
        prefix = f"{channel}." if channel else ""
        whole = name in self._columns
        parts = [f"{prefix}{each}" for each in places if whole or prefix + each.removeprefix(RESULT) == name]
        if not parts:
            raise self._unknown(name)
        return parts

    def _unknown(self, name: str) -> LocalError:
        hint = f"; a picture is written with path={name!r}" if name.endswith(PICTURES) else ""
        return LocalError(f"there is no column {name!r}; there are: {', '.join(self.columns) or 'none'}{hint}")

    def _along(self, topic: str, fields: Sequence[str]) -> Array | None:
        """Return what the world told of each robot under a topic, at the times of its states."""
        said: dict[str, list[tuple[float, ...]]] = {robot: [] for robot in self.robots}
        for sample in self.recording.samples(f"swarm/*/sim/{topic}"):
            rows = said.get(sample.topic.split("/")[1])
            if rows is not None:  # a robot may never have told a state
                rows.append((sample.t, *(sample.message[field] for field in fields)))
        if not any(said.values()):
            return None
        found = np.full((*self.times.shape, len(fields)), np.nan)
        for robot, rows in enumerate(said.values()):
            samples = np.array(rows).reshape(-1, 1 + len(fields))
            there = ~np.isnan(self.times[:, robot])
            for place, field in enumerate(fields if len(samples) else ()):
                values = samples[:, 1 + place]
                values = np.unwrap(values) if field == "heading" else values
                found[there, robot, place] = _interpolated(self.times[there, robot], samples[:, 0], values)
        return found


def table_of(columns: Any) -> "pd.DataFrame":
    """Return a pandas table. Raises `LocalError` where there is no pandas."""
    try:
        import pandas as pd
    except ImportError:
        raise MissingPackageError("to_pandas", "pandas", "notebook") from None
    return pd.DataFrame(columns)


def load(path: str | Path, app: str = "") -> RunData:
    """Load a recorded run, of real robots (`swarm fetch`) or of a simulation (`swarm sim --record`, `RunData.save`).

    `path` is its folder, or one recording (.mcap) of it; `app` chooses one app if robots ran
    several. Raises `RecordingError` if there is no recording or it cannot be read. What is damaged in it is warned of.
    """
    run = RunData(Path(path), app)
    for damage in run.recording.damage:
        warnings.warn(f"swarm.load: {damage}", stacklevel=2)
    return run


def _interpolated(times: Array, known: Array, values: Array) -> Array:
    """Return values at `times`: linear between the samples, and from the nearest two before the first and after the
    last."""
    if len(known) == 1:
        return np.full(times.shape, values[0])
    after = np.clip(np.searchsorted(known, times), 1, len(known) - 1)
    share = (times - known[after - 1]) / (known[after] - known[after - 1])
    found: Array = values[after - 1] + share * (values[after] - values[after - 1])
    return found


def _rows(paths: Mapping[str, Trajectory]) -> int:
    return 1 + max((path.last for path in paths.values()), default=-1)


def _times(paths: Mapping[str, Trajectory]) -> Array:
    found = np.full((_rows(paths), len(paths)), np.nan)
    for robot, path in enumerate(paths.values()):
        ks = [k for k in path.times if k in path.rows]
        found[ks, robot] = [path.times[k] for k in ks]
    return found


def _array(paths: Mapping[str, Trajectory], column: str) -> Array:
    """Return a column, of shape (iteration, robot)."""
    cells: list[list[str]] = []
    places: list[list[int]] = []
    rows = _rows(paths)
    for path in paths.values():
        at = path.columns.index(column) if path.columns else 0
        places.append(list(path.rows))
        cells.append([row[at] for row in path.rows.values()])
    texts = {text for each in cells for text in each}
    whole = all(len(each) == rows for each in cells)
    convert, kind, missing = _kind(texts, whole=whole)
    found = np.full((rows, len(cells)), missing, dtype=kind)
    for robot, (ks, each) in enumerate(zip(places, cells, strict=True)):
        found[ks, robot] = [convert(text) for text in each]
    return found


def _kind(texts: set[str], *, whole: bool) -> tuple[Any, Any, Any]:
    """Return how cells become entries, their type, and the entry for a missing cell."""
    if texts <= {"True", "False"}:
        return ("True".__eq__, bool, False) if whole else ({"True": 1.0, "False": 0.0}.__getitem__, float, np.nan)
    try:
        if whole:
            [int(text) for text in texts]
            return int, np.int64, 0
    except ValueError:
        pass
    try:
        [float(text) for text in texts]
    except ValueError:
        return str, object, None
    return float, float, np.nan
