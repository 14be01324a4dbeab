"""Reads a recording, one message after the other, as far as the file is whole; what is not is named in `damage`."""

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

from swarm.errors import RecordingError
from swarm.recording.core import json_text, mcap

SUFFIX = ".mcap"

RUN = "run"
"""Name of the metadata record that every process of ours writes first: app, run, robot, version, seed, ..."""
EPOCH = "epoch_ns"
"""Its entry that says which time of day, ns since 1970, the process' clock had at its zero."""

_NO_TIME = 1 << 64

OUTCOME = "outcome"
"""Name of the metadata record that ends the recording of a run in virtual time: `messages`, `problems` (JSON)."""
SHAPES = "shapes"
"""Name of the metadata record that says how many rows and columns the app's matrices have: `4x4`, by field."""
PLOTTED = "plotted"
"""Name of the metadata record that says what the app's author wants to be drawn: names, by app."""
MEMBERS = "members"
"""Name of the metadata record that has the members of enums in declared order, by app and field: `app.field`."""
WORLD_CLOCK = "world_clock"
"""Name of the metadata record of a simulation that says how the file's clock relates to the world's time, which is
t + `offset` + `rate` t, s."""
CLOCK = "clock"
"""Its entry that names the clock: of a machine since it was started, or a virtual one."""


class RecordedSample(NamedTuple):
    """One recorded message."""

    topic: str
    t: float
    """The time at which it was recorded, s of the recording process' clock."""
    data: bytes
    """JSON text."""

    @property
    def message(self) -> dict[str, Any]:
        """The message's fields. What was None is missing; raises `RecordingError` where the text is no JSON."""
        try:
            message = json_text.decode(self.data)
        except (ValueError, RecursionError) as error:
            raise RecordingError(f"{self.topic}: a message is not JSON: {error}") from None
        if not isinstance(message, dict):
            raise RecordingError(f"{self.topic}: a message is no JSON object")
        return message


class RecordingReader:
    """One file. May be iterated again while it grows: then it goes on behind the last whole record."""

    def __init__(self, path: Path) -> None:
        """Raises `RecordingError` for a file that is none."""
        self.path = path
        self.channels: dict[int, mcap.McapChannel] = {}
        """Seen so far, by number."""
        self.schemas: dict[int, mcap.McapSchema] = {}
        self.metadata: list[tuple[str, dict[str, str]]] = []
        """Name and entries of each, in order, as far as was read."""
        self.damage: list[str] = []
        """What cannot be read, and where."""
        self.finished = False
        """Whether the file has its proper end."""
        self.clock = ""
        """The clock whose times are read at the moment: processes that say the same run on the same clock."""
        self.clocks: dict[str, int] = {}
        """The clocks read so far, each with the time of day at its zero, ns since 1970."""
        self._epoch_ns = 0
        self._at = len(mcap.MAGIC)
        try:
            with path.open("rb") as file:
                begins = file.read(len(mcap.MAGIC))
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
        if begins != mcap.MAGIC[: len(begins)]:
            raise RecordingError(f"{path}: it is no MCAP file")

    def samples(self, wanted: Callable[[str], bool] = lambda topic: True) -> Iterator[RecordedSample]:
        """Yield the messages of the topics that are `wanted`, in the order of their writing."""
        self.damage.clear()
        self.finished = False  # a process that was started again goes on with what the one before had ended
        chosen: dict[int, str | None] = {}
        """The topic of each channel so far; None where it is not wanted."""
        with self.path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            if size <= len(mcap.MAGIC):
                self._name(0, "it was only begun")
            while self._at < size and not self.finished:
                start = self._at
                file.seek(start)
                head = file.read(mcap.HEAD.size)
                if len(head) < mcap.HEAD.size:
                    self._cut(size)
                    return
                opcode, length = mcap.HEAD.unpack(head)
                after = start + mcap.HEAD.size + length
                torn = after > size
                if opcode == mcap.NOTHING or (torn and opcode != mcap.CHUNK):
                    self._cut(size)
                    return
                if opcode in (mcap.DATA_END, mcap.FOOTER):
                    file.seek(-len(mcap.MAGIC), os.SEEK_END)
                    self.finished = file.read() == mcap.MAGIC
                    if not self.finished:
                        self._cut(size)
                    return
                if opcode == mcap.MESSAGE_INDEX:
                    self._at = after
                    continue
                if min(length, size - start) > mcap.LARGEST:
                    self._name(start, f"a record of {length} bytes: at most {mcap.LARGEST} are read")
                    if torn:
                        return
                    self._at = after
                    continue
                content = file.read(min(length, size - start))
                try:
                    for message in self._messages(opcode, content, torn=torn):
                        if (channel := self.channels.get(message.channel)) is None:
                            self._name(start, f"a message of channel {message.channel}, which is not described")
                            continue
                        if message.channel not in chosen:
                            chosen[message.channel] = channel.topic if wanted(channel.topic) else None
                        if (topic := chosen[message.channel]) is not None:
                            yield RecordedSample(topic, (message.log_time - self._epoch_ns) / 1e9, message.data)
                except RecordingError as error:
                    if not torn:
                        self._name(start, str(error))
                if torn:
                    self._cut(size)
                    return
                self._at = after

    def _messages(self, opcode: int, content: bytes, *, torn: bool) -> Iterator[mcap.McapMessage]:
        """Yield the messages of a record, and note what else it says."""
        if opcode != mcap.CHUNK:
            records: Iterable[tuple[int, int, bytes | memoryview]] = ((0, opcode, content),)
        else:
            chunk = mcap.read_chunk(content)
            if chunk.compression:
                raise RecordingError(f"a chunk is compressed with {chunk.compression!r}, which is not read here")
            if not torn and chunk.crc and crc32(chunk.records) != chunk.crc:
                raise RecordingError(f"the checksum of a chunk of {len(chunk.records)} bytes is wrong")
            records = mcap.whole_records(chunk.records)
        for _, inner, record in records:
            if inner == mcap.MESSAGE:
                yield mcap.read_message(record)
            else:
                self._note(inner, record)

    def _note(self, opcode: int, content: bytes | memoryview) -> None:
        """Note what a record says that is neither a message nor a chunk; chunks hold no chunks."""
        if opcode == mcap.SCHEMA:
            schema = mcap.read_schema(content)
            self.schemas[schema.id] = schema
        elif opcode == mcap.CHANNEL:
            channel = mcap.read_channel(content)
            if channel.encoding != "json":
                raise RecordingError(f"{channel.topic} is in {channel.encoding!r}, only json can be read")
            self.channels[channel.id] = channel
        elif opcode == mcap.METADATA:
            name, entries = mcap.read_metadata(content)
            self.metadata.append((name, entries))
            if name == RUN:
                self._epoch_ns = _time(entries.get(EPOCH, "0"))
                self.clock = entries.get(CLOCK, "")
                self.clocks.setdefault(self.clock, self._epoch_ns)

    def _cut(self, size: int) -> None:
        self._name(self._at, f"it was cut off: the last {size - self._at} bytes are no whole record")

    def _name(self, at: int, what: str) -> None:
        self.damage.append(f"{self.path}: at byte {at}: {what}")


def shapes_of(metadata: Iterable[tuple[str, dict[str, str]]]) -> dict[str, tuple[int, ...]]:
    """Return the shape of each field with several axes, as a recording's metadata has them."""
    texts = {field: text for name, entries in metadata if name == SHAPES for field, text in entries.items()}
    parts = {field: text.split("x") for field, text in texts.items()}
    return {field: tuple(map(int, sizes)) for field, sizes in parts.items() if all(map(str.isdecimal, sizes))}


def _time(text: str) -> int:
    """Nanoseconds in a text; `RecordingError` where they do not fit the format's 64 bits."""
    try:
        found = int(text)
    except ValueError:
        found = _NO_TIME
    if abs(found) >= _NO_TIME:
        raise RecordingError(f"{EPOCH} is {text[:40]!r}, expected a whole number of 64 bits")
    return found


def run_of(path: Path) -> str:
    """Return the run that a recording is of; empty where it names none. Raises `RecordingError` or `OSError` where it
    cannot be read."""
    reader = RecordingReader(path)
    next(reader.samples(), None)
    return next((entries.get("run", "") for name, entries in reader.metadata if name == RUN), "")
