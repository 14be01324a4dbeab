"""The bytes of an MCAP file: the writer takes (topic, time, message), and gives pieces to be appended.

    writer = Writer("balboa-swarm 0.1.0", epoch_ns=0)
    writer.metadata("run", {"app": "consensus"})
    writer.write("swarm/r0/app/consensus/state", 12.5, AppState(...))
    file.write(writer.take())       # as often as one likes: it gives whole records only
    for piece in writer.finish(read):   # gives what it has not given, and the file's end
        file.write(piece)

No clock and no file in here, and what it gives depends on nothing but what it was given: same messages, same bytes.
Topics are keys of the bus. Times are of the recording process' clock, s; in the file they stand as nanoseconds since
1970, `epoch_ns` after them (the clock's zero; 0 in virtual time).
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

from swarm.errors import LocalError, RecordingError
from swarm.messages import Pose
from swarm.recording.core import foxglove, json_text, mcap

CHUNK_SIZE = 256 * 1024
"""Bytes of messages after which a chunk ends."""
CHUNK_NS = 1_000_000_000
"""ns between a chunk's first message and the one that ends it."""

INDEX_SIZE = 64 * 1024
"""Bytes of chunk indexes that are kept in memory: then a checkpoint takes them into the file. A chunk with five topics
has some 120."""

MAX_CHANNELS = 65_535
"""The format has 16 bits for them."""


@dataclass
class ExistingContent:
    """The content of an existing file to which a writer adds."""

    position: int = 0
    """Bytes of whole records."""
    schemas: dict[int, mcap.McapSchema] = field(default_factory=dict)
    channels: dict[int, mcap.McapChannel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    """Messages by channel."""
    chunk_indexes: bytearray = field(default_factory=bytearray)
    """Index records of its chunks since the last checkpoint."""
    checkpoints: list[int] = field(default_factory=list)
    """Offsets in the file; each holds the index records of the chunks since the one before it."""
    chunks: int = 0
    metadata_indexes: bytearray = field(default_factory=bytearray)
    metadatas: int = 0
    start: int = 0
    """Smallest log time, ns; 0 where there are no messages."""
    end: int = 0

    def add_chunk(self, start: int, end: int, length: int, indexes: Mapping[int, int], size: int) -> None:
        """Note a chunk record of `length` bytes that begins at `position`, with its message indexes behind it: their
        offsets by channel, the end of the last as -1."""
        self.chunk_indexes += mcap.chunk_index(start, end, self.position, length, indexes, size)
        self.start = min(self.start, start) if self.chunks else start
        self.end = max(self.end, end)
        self.chunks += 1
        self.position = indexes[-1]

    def describe(self, opcode: int, content: bytes | memoryview) -> None:
        """Note the schema or the channel of a record; other records say nothing here."""
        if opcode == mcap.SCHEMA:
            schema = mcap.read_schema(content)
            self.schemas[schema.id] = schema
        elif opcode == mcap.CHANNEL:
            channel = mcap.read_channel(content)
            self.channels[channel.id] = channel
            self.counts.setdefault(channel.id, 0)

    def add_metadata(self, length: int, name: str) -> None:
        """Note a metadata record of `length` bytes that begins at `position`."""
        self.metadata_indexes += mcap.metadata_index(self.position, length, name)
        self.metadatas += 1
        self.position += length

    def summary(self) -> tuple[tuple[int, bytes], ...]:
        """Opcode and records of each group of a summary but the chunk indexes."""
        counted = mcap.statistics(self.counts, len(self.schemas), self.chunks, self.metadatas, self.start, self.end)
        return (
            (mcap.SCHEMA, b"".join(map(mcap.schema, self.schemas.values()))),
            (mcap.CHANNEL, b"".join(map(mcap.channel, self.channels.values()))),
            (mcap.STATISTICS, counted),
            (mcap.METADATA_INDEX, bytes(self.metadata_indexes)),
        )

    def add_checkpoint(self, length: int) -> None:
        """Note a checkpoint record of `length` bytes at `position`, which holds the chunk indexes so far."""
        self.checkpoints.append(self.position)
        self.position += length
        self.chunk_indexes = bytearray()


def recall(at: int, content: bytes, checkpoints: list[int]) -> ExistingContent:
    """Return what a restart has to know of a file up to the checkpoint at `at`, with this checkpoint. `checkpoints`:
    offsets of those before it. Raises `RecordingError` where the content is damaged."""
    _, summary = mcap.read_checkpoint(at, content)
    known = ExistingContent(at + mcap.HEAD.size + len(content), checkpoints=[*checkpoints, at])
    for start, opcode, inside in mcap.whole_records(summary):
        known.describe(opcode, inside)
        if opcode == mcap.STATISTICS:
            known.counts, known.chunks, known.metadatas, known.start, known.end = mcap.read_statistics(inside)
        elif opcode == mcap.METADATA_INDEX:
            known.metadata_indexes += summary[start : start + mcap.HEAD.size + len(inside)]
    return known


def _unwritten(at: int, length: int) -> bytes:
    raise RecordingError(f"{length} bytes at {at} are to be read again, and nobody said where")


class Writer:
    """Collects messages into chunks."""

    def __init__(
        self,
        library: str,
        *,
        epoch_ns: int,
        known: ExistingContent | None = None,
        keep: Callable[[bytes], None] = lambda record: None,
    ) -> None:
        """`known`: what the file holds already, which this goes on with. `keep(record)` is given every record as soon
        as it was written, which `take` does only when its chunk ends; `restore` takes it back."""
        self._keep = keep
        self.epoch_ns = epoch_ns
        self._known = known or ExistingContent()
        self._ids = {channel.topic: channel.id for channel in self._known.channels.values()}
        self._ready = bytearray()
        self._chunk = bytearray()
        self._indexes: dict[int, bytearray] = {}
        self._first = self._start = self._end = 0
        if not self._known.position:
            self._put(mcap.header(library))

    @property
    def waiting(self) -> int:
        """Bytes that were written and not yet taken."""
        return len(self._ready) + len(self._chunk)

    @property
    def ready(self) -> bool:
        """Whether there is something to take."""
        return bool(self._ready)

    def write(self, topic: str, t: float, message: object, name: str = "") -> None:
        """Record a message (a dataclass or a mapping). `name` is what its schema is called, which its first message on
        this topic gives; default: of its class.

        Raises `LocalError` for a message that JSON cannot carry, or more topics than there may be.
        """
        log_time = self.epoch_ns + round(t * 1e9)
        data = foxglove.pose(message, log_time) if type(message) is Pose else json_text.encode(message)
        channel = self._ids.get(topic)
        if channel is None:
            channel = self._open(topic, *self._shape(message, name))
        self._message(channel, log_time, data)

    def write_text(self, topic: str, t: float, data: bytes, schema: mcap.McapSchema) -> None:
        """Record a message out of another recording: JSON text, with its schema there."""
        channel = self._ids.get(topic)
        if channel is None:
            channel = self._open(topic, schema.name, schema.data)
        self._message(channel, self.epoch_ns + round(t * 1e9), data)

    def _message(self, channel: int, log_time: int, data: bytes) -> None:
        counts = self._known.counts
        sequence = counts[channel] = counts[channel] + 1
        head = mcap.MESSAGE_HEAD.pack(mcap.MESSAGE, 22 + len(data), channel, sequence & 0xFFFFFFFF, log_time, log_time)
        self._append(channel, log_time, head + data)

    def restore(self, record: bytes) -> None:
        """Write a record again that `keep` was given; raises `RecordingError` where it is none."""
        ((_, opcode, content),) = mcap.whole_records(record)
        if opcode == mcap.MESSAGE:
            message = mcap.read_message(content)
            if message.channel not in self._known.counts:
                raise RecordingError(f"a message of channel {message.channel}, which is not described")
            self._known.counts[message.channel] += 1
            self._append(message.channel, message.log_time, record)
        elif opcode == mcap.METADATA:
            name, entries = mcap.read_metadata(content)
            self.metadata(name, entries)
        elif opcode == mcap.SCHEMA:
            self._add_schema(mcap.read_schema(content))
        elif opcode == mcap.CHANNEL:
            self._add_channel(mcap.read_channel(content))

    def _append(self, channel: int, log_time: int, record: bytes) -> None:
        """Put a message record into the chunk, or into the next one where this one is full or old."""
        if self._chunk and (log_time - self._first >= CHUNK_NS or len(self._chunk) >= CHUNK_SIZE):
            self.cut()
        if not self._chunk:
            self._first = self._start = self._end = log_time
        index = self._indexes.get(channel)
        if index is None:
            index = self._indexes[channel] = bytearray()
        index += mcap.INDEX_ENTRY.pack(log_time, len(self._chunk))
        self._chunk += record
        self._keep(record)
        if log_time < self._start:
            self._start = log_time
        elif log_time > self._end:
            self._end = log_time

    def metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Note something about the whole recording."""
        self.cut()
        packed = mcap.metadata(name, entries)
        self._ready += packed
        self._keep(packed)
        self._known.add_metadata(len(packed), name)

    def cut(self) -> None:
        """End the chunk, so that all that was written can be taken."""
        if not self._chunk:
            return
        known = self._known
        packed = mcap.chunk(self._start, self._end, self._chunk)
        at = known.position + len(packed)
        indexes = bytearray()
        places = {}
        for channel, entries in self._indexes.items():
            places[channel] = at + len(indexes)
            indexes += mcap.message_index(channel, entries)
        places[-1] = at + len(indexes)
        self._ready += packed
        self._ready += indexes
        known.add_chunk(self._start, self._end, len(packed), places, len(self._chunk))
        self._chunk = bytearray()
        self._indexes = {}
        if len(known.chunk_indexes) >= INDEX_SIZE:
            packed = mcap.checkpoint(
                known.position, known.chunk_indexes, b"".join(records for _, records in known.summary())
            )
            self._ready += packed
            known.add_checkpoint(len(packed))

    @property
    def checkpoints(self) -> list[int]:
        """Offsets of the file's checkpoints. Those that are in it already may be linked (`mcap.link`), so that a
        restart need not look at what is between them."""
        return self._known.checkpoints

    def finish(self, read: Callable[[int, int], bytes] = _unwritten) -> Iterator[bytes]:
        """End the file: what was not taken yet, the summary and the index, behind which nothing may be written.

        `read(offset, length)` gives bytes of the file again, which long recordings need. Raises `RecordingError` where
        they are not what they were.
        """
        self.cut()
        yield self.take()
        summary = [(opcode, (records,)) for opcode, records in self._known.summary()]
        yield from mcap.ending(self._known.position, [*summary, (mcap.CHUNK_INDEX, self._chunk_indexes(read))])

    def _chunk_indexes(self, read: Callable[[int, int], bytes]) -> Iterator[bytes]:
        """Yield the indexes of all chunks, oldest first; the file's checkpoints hold the old ones. Raises
        `RecordingError` where some are missing."""
        count = 0
        for at in self._known.checkpoints:
            head = read(at, mcap.HEAD.size)
            if len(head) < mcap.HEAD.size:
                raise RecordingError(f"the checkpoint at {at} is not there any more")
            _, length = mcap.HEAD.unpack(head)
            packed, _ = mcap.read_checkpoint(at, read(at + mcap.HEAD.size, length))
            count += sum(1 for _ in mcap.whole_records(packed))
            yield packed
        newest = bytes(self._known.chunk_indexes)
        count += sum(1 for _ in mcap.whole_records(newest))
        if count != self._known.chunks:
            raise RecordingError(f"the file's checkpoints index {count} of {self._known.chunks} chunks")
        yield newest

    def take(self) -> bytes:
        """Return the records that are complete since the last call, to be appended to the file. Messages of the chunk
        that is still open are not among them: `cut` first where they are to be."""
        data = bytes(self._ready)
        self._ready.clear()
        return data

    def _shape(self, message: object, name: str) -> tuple[str, bytes]:
        """Name and text of the schema of messages like this one."""
        if type(message) is Pose:
            return foxglove.POSE, foxglove.pose_schema()
        name = name or f"swarm.{type(message).__name__}"
        return name, json_text.schema(message, name)

    def _open(self, topic: str, name: str, shape: bytes) -> int:
        """Open a new channel, with its schema. Both stand before the chunk that is open now, whose position moves."""
        known = self._known
        number = len(known.channels) + 1
        if number > MAX_CHANNELS:
            raise LocalError(f"{topic}: a recording has at most {MAX_CHANNELS} topics")
        schema = next((it for it in known.schemas.values() if (it.name, it.data) == (name, shape)), None)
        if schema is None:
            schema = mcap.McapSchema(len(known.schemas) + 1, name, "jsonschema", shape)
            self._add_schema(schema)
        self._add_channel(mcap.McapChannel(number, schema.id, topic, "json", {}))
        return number

    def _add_schema(self, schema: mcap.McapSchema) -> None:
        self._known.schemas[schema.id] = schema
        packed = mcap.schema(schema)
        self._put(packed)
        self._keep(packed)

    def _add_channel(self, channel: mcap.McapChannel) -> None:
        self._known.channels[channel.id] = channel
        self._known.counts[channel.id] = 0
        self._ids[channel.topic] = channel.id
        packed = mcap.channel(channel)
        self._put(packed)
        self._keep(packed)

    def _put(self, data: bytes) -> None:
        self._ready += data
        self._known.position += len(data)
