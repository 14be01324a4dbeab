"""A whole run: the recordings of all its robots and apps in one folder, read as one, on one time axis."""

import heapq
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cached_property
from itertools import groupby
from pathlib import Path

from swarm.errors import RecordingError
from swarm.recording import folder
from swarm.recording.axis import WORLD, Axis, Clocks, Relation
from swarm.recording.core.mcap import McapSchema
from swarm.recording.reader import SUFFIX, WORLD_CLOCK, RecordedSample, RecordingReader, shapes_of
from swarm.recording.trajectory import Builder, Trajectory, beside, is_state

_NO_SCHEMA = McapSchema(0, "", "", b"{}")

DISORDER_S = 5.0
"""Seconds by which a message may stand in a file behind later ones: what came over the bus is written once a second."""


class Run:
    """One run. `samples` streams from the files; nothing but the list of topics is kept."""

    def __init__(self, path: Path, app: str = "") -> None:
        """`path`: the run's folder, or one recording of it. `app`: which one is looked at where robots ran several.
        Raises `RecordingError` where there is none."""
        self.path = path
        self.files = tuple(sorted(path.glob(f"*{SUFFIX}"))) if path.is_dir() else (path,)
        if not self.files:
            tables = "; swarm import reads the thesis' CSV files" if any(path.glob("*.csv")) else ""
            raise RecordingError(f"{path}: there is no recording (*{SUFFIX}) in this folder{tables}")
        self.info = folder.read_run(path) if path.is_dir() else {}
        """App, run, version, seed and digest."""
        self.topics: dict[str, list[Path]] = {}
        """Every topic, and the files that hold it."""
        self.schemas: dict[str, McapSchema] = {}
        """The schema of each topic."""
        self._metadata: list[tuple[str, dict[str, str]]] = []
        self._numbers: dict[str, str] = {}
        """The run's number by app, as the first file has it."""
        self.damage: list[str] = []
        """What cannot be read in the files, and doubts about their times, in words."""
        self._begun: dict[tuple[str, str], float] = {}
        """Time of the first message by clock and topic, s of that clock."""
        clocks = Clocks()
        for file in self.files:
            self._look(file, clocks)
        self._axes = clocks.axes()
        self.damage += clocks.notes
        self.basis = clocks.basis
        """What the common time is of, see `Clocks`."""
        self.epoch = clocks.epoch
        """The time of day at the zero of common time, s since 1970, as well as it is known; 0 in virtual time."""
        self.robots = tuple(sorted({topic.split("/")[1] for topic in self.topics if topic.count("/") > 2}, key=natural))
        if app and app not in self.apps:
            raise RecordingError(f"{path}: no app {app} is recorded; there are: {', '.join(self.apps) or 'none'}")
        about = self.info.get("app", "")
        self.app = app or (about if about in self.apps else next(iter(self.apps), ""))
        """The app that is looked at: the one asked for, else the one that the run is about."""
        self.origin = self._origin()
        """Common time at which the first state was reached (without an app: of the first message); `samples` count from
        there."""

    @property
    def apps(self) -> tuple[str, ...]:
        """Names of the apps whose states are there."""
        return tuple(sorted({topic.split("/")[3] for topic in self.topics if is_state(topic)}))

    @property
    def built_in(self) -> str:
        """The name of the app that is looked at, where it is a built-in one. Empty where it is an author's, which may
        have the same name: its source stands beside the recordings."""
        place = self.path if self.path.is_dir() else self.path.parent
        return "" if (place / f"{self.app}.py").exists() else self.app

    def notes(self, name: str) -> list[dict[str, str]]:
        """Return the metadata records of a name."""
        return [entries for known, entries in self._metadata if known == name]

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """The shape of each field with several axes: messages hold them as one row after the other."""
        return shapes_of(self._metadata)

    def states(self, app: str = "") -> dict[str, dict[str, str]]:
        """Return the topics of an app's states (default: of the one looked at), by channel (the app itself is ``) and
        robot."""
        app = app or self.app
        found: dict[str, dict[str, str]] = {}
        for topic in sorted((topic for topic in self.topics if is_state(topic)), key=natural):
            _, robot, _, name, *rest = topic.split("/")
            if name == app:
                found.setdefault(rest[0] if len(rest) == 2 else "", {})[robot] = topic
        return found

    def trajectories(self, app: str = "", channel: str = "") -> dict[str, Trajectory]:
        """Return each robot's trajectory, with times from `origin` on. Of an iteration that was recorded twice the
        later one counts; `damage` reports it where the two differ."""
        topics = {topic: robot for robot, topic in self.states(app).get(channel, {}).items()}
        found = {robot: Builder(strict=False) for robot in topics.values()}
        for builder in found.values():
            builder.shapes = self.shapes
        told = {each: robot for topic, robot in topics.items() for each in beside(topic)}
        for file in self.files:
            for sample in self._read(file, {*topics, *told}.__contains__):
                if sample.topic in told:
                    found[told[sample.topic]].heed(sample.topic, sample.message)
                else:
                    found[topics[sample.topic]].add(sample.message, file, sample.t)
        for robot, builder in found.items():
            if builder.forks:
                note = f"{robot}: {len(builder.forks)} iterations stand there twice and differ (it began anew)"
                self.damage += [] if note in self.damage else [note]
        return {robot: builder.known() for robot, builder in found.items()}

    def samples(self, *keys: str) -> Iterator[RecordedSample]:
        """Yield all messages of the topics that one of `keys` names, in the order of common time from `origin` on.
        As on the bus `*` is any one chunk and `**` any number of them; without keys all topics come. A message that
        two apps of a robot have recorded comes once, as often as one of them has it."""
        patterns = tuple(map(_pattern, keys))
        merged = heapq.merge(*(self._ordered(file, patterns) for file in self.files), key=_place)
        for _, same in groupby(merged, key=_place):
            # What came at the same instant stays in the order of its writing.
            had: Counter[tuple[Path, bytes]] = Counter()
            told: Counter[bytes] = Counter()
            for file, sample in same:
                had[file, sample.data] += 1
                if had[file, sample.data] > told[sample.data]:
                    told[sample.data] += 1
                    yield sample

    def _look(self, file: Path, clocks: Clocks) -> None:
        """First pass: what is in a file, and how its clocks relate."""
        reader = RecordingReader(file)
        for sample in reader.samples():
            clock = reader.clock
            of = clock, sample.topic
            if sample.t < self._begun.get(of, math.inf):
                self._begun[of] = sample.t
            if sample.topic.endswith("/mesh/clock"):
                message = sample.message
                try:
                    t, offset, rate = (float(message[name]) for name in ("t", "offset", "rate"))
                    clocks.relate(clock, Relation(t, offset, rate, str(message["root"])))
                except (KeyError, TypeError, ValueError):
                    self.damage.append(f"{file}: {sample.topic}: it is no sample of the mesh clock")
        for clock, epoch_ns in reader.clocks.items():
            clocks.add(clock, epoch_ns / 1e9)
        for channel in reader.channels.values():
            self.topics.setdefault(channel.topic, []).append(file)
            self.schemas[channel.topic] = reader.schemas.get(channel.schema, _NO_SCHEMA)
        self.damage += reader.damage
        self._metadata += reader.metadata
        for name, entries in reader.metadata:
            if name == "run":
                app, number = entries.get("app", ""), entries.get("run", "")
                if (known := self._numbers.setdefault(app, number)) != number:
                    self.damage.append(f"{file}: it is of run {number} of {app}, other files are of run {known}")
                self.info = {**{key: entries[key] for key in folder.KEYS if key in entries}, **self.info}
            elif name == WORLD_CLOCK:
                try:
                    clocks.relate(reader.clock, Relation(0.0, float(entries["offset"]), float(entries["rate"]), WORLD))
                except (KeyError, ValueError):
                    self.damage.append(f"{file}: {WORLD_CLOCK}: expected numbers `offset` and `rate`, got {entries}")

    def _read(self, file: Path, wanted: Callable[[str], bool]) -> Iterator[RecordedSample]:
        reader = RecordingReader(file)
        for topic, t, data in reader.samples(wanted):
            yield RecordedSample(topic, self._axis(reader.clock)(t) - self.origin, data)

    def _axis(self, clock: str) -> Axis:
        return self._axes.get(clock, float)

    def _ordered(self, file: Path, patterns: tuple[re.Pattern[str], ...]) -> Iterator[tuple[Path, RecordedSample]]:
        """Yield a file's messages by time, after waiting for those that were written late."""

        def wanted(topic: str) -> bool:
            return not patterns or any(pattern.fullmatch(topic) for pattern in patterns)

        waiting: list[tuple[float, str, int, RecordedSample]] = []
        latest = float("-inf")
        for number, sample in enumerate(self._read(file, wanted)):
            heapq.heappush(waiting, (*_order(sample), number, sample))
            latest = max(latest, sample.t)
            while waiting[0][0] < latest - DISORDER_S:
                yield file, heapq.heappop(waiting)[-1]
        while waiting:
            yield file, heapq.heappop(waiting)[-1]

    def _origin(self) -> float:
        begun = {of: t for of, t in self._begun.items() if is_state(of[1])} or self._begun
        return min((self._axis(clock)(t) for (clock, _), t in begun.items()), default=0.0)


def _pattern(key: str) -> re.Pattern[str]:
    """Return the pattern of the keys that a key expression of the bus matches."""
    chunks = (".*" if chunk == "**" else re.escape(chunk).replace(r"\*", "[^/]*") for chunk in key.split("/"))
    text = "/".join(chunks).replace("/.*/", "/(?:.*/)?")
    return re.compile(re.sub(r"^\.\*/", "(?:.*/)?", re.sub(r"/\.\*$", "(?:/.*)?", text)))


def natural(text: str) -> tuple[object, ...]:
    """Sorts r10 behind r9."""
    return tuple((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", text))


def _place(entry: tuple[Path, RecordedSample]) -> tuple[float, str]:
    return _order(entry[1])


def _order(sample: RecordedSample) -> tuple[float, str]:
    return sample.t, sample.topic
