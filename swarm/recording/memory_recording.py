"""A recording of virtual time that is held in memory, and written to its file when somebody asks for that."""

import weakref
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from swarm.errors import LocalError
from swarm.messages import Pose
from swarm.recording.core import foxglove
from swarm.recording.core.mcap import McapSchema
from swarm.recording.core.writer import schema_of
from swarm.recording.reader import RUN, RecordedSample, RecordingReader
from swarm.recording.virtual_file import VIRTUAL, DirectRecording, described

MOST = 200_000
"""Messages that are held, of all runs together, each some 1 kB. What is more is written to its file, the oldest
first."""


class _Note(NamedTuple):
    """A record of metadata."""

    name: str
    entries: dict[str, str]


class MemoryRecording:
    """One recording: the same messages as of a `DirectRecording`, and the same bytes once it is in its file."""

    def __init__(self, path: Path, run: Mapping[str, str], clock: str = VIRTUAL) -> None:
        """See `DirectRecording`."""
        self._path, self._run, self._clock = path, run, clock
        self._records: list[_Note | RecordedSample] = []
        """The messages do not change: they are frozen, or mappings of JSON's values that were made for this."""
        self._names: dict[str, str] = {}
        """The names of schemas by topic."""
        self._file: DirectRecording | None = None
        """The file, once it is written."""
        self._closed = False

    def metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Note something about the whole recording."""
        if self._file is None:
            self._records.append(_Note(name, dict(entries)))
        else:
            self._file.metadata(name, entries)

    def write(self, topic: str, t: float, message: object, name: str = "") -> None:
        """Record a message; see `Writer.write`."""
        if self._file is not None:
            self._file.write(topic, t, message, name)
            return
        self._records.append(RecordedSample(topic, round(t * 1e9) / 1e9, message))
        self._names.setdefault(topic, name)
        if len(self._records) >= MOST:
            self.write_out()

    def flush(self) -> None:
        """Do nothing: what is held can be read, as can what is in the file after the end."""

    def close(self) -> None:
        """End the recording. Raises `LocalError` where it, or an older one that has to make room, cannot be written."""
        self._closed = True
        if self._file is not None:
            self._file.close()
            return
        _ended.append(weakref.ref(self, _ended.remove))
        waiting = [each for reference in tuple(_ended) if (each := reference()) is not None]
        count = sum(len(each._records) for each in waiting)
        for each in waiting:
            if count > MOST:
                count -= len(each._records)
                each.write_out()

    def write_out(self) -> None:
        """Put it into its file, and hold it no more. Raises `LocalError` where that cannot be written; it can still be
        read then, and be written later."""
        if self._file is not None:
            return
        file = DirectRecording(self._path, self._run, self._clock)
        try:
            for record in self._records:
                if isinstance(record, _Note):
                    file.metadata(*record)
                else:
                    file.write(*record, self._names[record.topic])
            if self._closed:
                file.close()
        except LocalError:
            file.abandon()
            raise
        self._file, self._records = file, []

    def reader(self) -> "RecordingReader | MemoryReader":
        """Return a reader of what was recorded."""
        if self._file is not None:
            return RecordingReader(self._path)
        return MemoryReader(self._records, self._names, described(self._run, self._clock), self._clock)


_ended: list["weakref.ref[MemoryRecording]"] = []


class MemoryReader:
    """Reads a recording in memory as `RecordingReader` reads a file."""

    def __init__(
        self, records: list[_Note | RecordedSample], names: Mapping[str, str], run: dict[str, str], clock: str
    ) -> None:
        """`names`: of schemas by topic; `run`: the first record of metadata."""
        self.clock = clock
        self.clocks = {clock: 0}
        self.damage: tuple[str, ...] = ()
        self._names = names
        self._samples = [record for record in records if not isinstance(record, _Note)]
        notes = [(record.name, record.entries) for record in records if isinstance(record, _Note)]
        self.metadata = [(RUN, run), *notes]
        self.topics = list(names)

    def topic_schemas(self) -> dict[str, McapSchema]:
        """Return the schema of the messages of each topic."""
        first = {sample.topic: sample for sample in reversed(self._samples)}
        shapes = {topic: schema_of(first[topic].content, name) for topic, name in self._names.items()}
        return {topic: McapSchema(0, name, "jsonschema", text) for topic, (name, text) in shapes.items()}

    def samples(self, wanted: Callable[[str], bool] = lambda topic: True) -> Iterator[RecordedSample]:
        """Yield the messages of the topics that are `wanted`, in the order of their writing."""
        chosen = set(filter(wanted, self.topics))
        for sample in self._samples:
            if sample.topic in chosen:
                if type(sample.content) is Pose:
                    pose = foxglove.pose(sample.content, round(sample.t * 1e9))
                    sample = sample._replace(content=pose)  # noqa: PLW2901 - as it is in a file
                yield sample
