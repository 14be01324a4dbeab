"""The MCAP container (https://mcap.dev/spec, version 0) as bytes: the records that we write, and those that we read.

Written here, in a hundred lines, because the `mcap` package costs a robot's process 9 MiB and 50 ms at import; tests
read what we write with that package. A file is `MAGIC`, records, `MAGIC`; a record is an opcode (u8), the content's
length (u64) and the content, all little endian. Messages stand in chunks, uncompressed, each chunk with its checksum
and followed by an index of each of its channels. Schemas, channels and metadata stand between the chunks.
"""

import struct
from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple
from zlib import crc32

from swarm.errors import RecordingError

MAGIC = b"\x89MCAP0\r\n"

NOTHING = 0
"""The opcode of no record: what a file has at its end that a power cut left with zeros."""

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(11, 16)
"""Opcodes; 9 and 10 are attachments, which we have none of."""
CHECKPOINT = 0x80
"""Opcode of a record of our own: what a summary would say at this place. Other readers step over it (the format leaves
0x80 and above to applications)."""

HEAD = struct.Struct("<BQ")
"""The beginning of every record: opcode and length of the content."""

LARGEST = 4 * 1024 * 1024
"""Bytes of one record that are read into memory. A damaged file may claim any length; ours are below 300 kB, but for a
single large message."""

MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""A message up to its data: opcode, length, channel, sequence, log time, publish time (ns)."""

_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")
_CHUNK_INDEX = struct.Struct("<QQQQ")
_STATISTICS = struct.Struct("<QHIIIIQQ")
_FOOTER = struct.Struct("<QQI")
_CHECKPOINT = struct.Struct("<QQI")
_LINK = struct.Struct("<Q")
CHECKPOINT_HEAD = HEAD.size + _CHECKPOINT.size
"""Bytes of a checkpoint record before what it holds."""
INDEX_ENTRY = struct.Struct("<QQ")
"""One message in an index of messages: log time, ns, and offset within the chunk's records."""
CHANNEL_ID = _U16 = struct.Struct("<H")
_COUNT = struct.Struct("<HQ")
_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")


class McapSchema(NamedTuple):
    """The schema of the messages of some channels."""

    id: int
    name: str
    encoding: str
    data: bytes


class McapChannel(NamedTuple):
    """The messages of one topic."""

    id: int
    schema: int
    topic: str
    encoding: str
    metadata: dict[str, str]


class McapMessage(NamedTuple):
    channel: int
    sequence: int
    log_time: int
    """ns"""
    data: bytes


class Chunk(NamedTuple):
    """A group of messages. `crc` 0: its content is not checked."""

    start: int
    """Smallest log time in it, ns."""
    end: int
    size: int
    crc: int
    compression: str
    records: bytes


class Statistics(NamedTuple):
    """Numbers of messages by channel, of chunks and metadata records, and the log times between which messages are."""

    counts: dict[int, int]
    chunks: int
    metadatas: int
    start: int
    """ns"""
    end: int


# What is written


def record(opcode: int, content: bytes) -> bytes:
    """Pack one record."""
    return HEAD.pack(opcode, len(content)) + content


def header(library: str) -> bytes:
    """Return the file's beginning, magic included."""
    return MAGIC + record(HEADER, _text("") + _text(library))


def schema(it: McapSchema) -> bytes:
    """Pack a schema record."""
    return record(SCHEMA, _U16.pack(it.id) + _text(it.name) + _text(it.encoding) + _block(it.data))


def channel(it: McapChannel) -> bytes:
    """Pack a channel record."""
    head = _U16.pack(it.id) + _U16.pack(it.schema)
    return record(CHANNEL, head + _text(it.topic) + _text(it.encoding) + _map(it.metadata))


def metadata(name: str, entries: Mapping[str, str]) -> bytes:
    """Pack a metadata record."""
    return record(METADATA, _text(name) + _map(entries))


def chunk(start: int, end: int, records: bytes | bytearray) -> bytes:
    """Pack the head of a chunk record over packed messages, without compression."""
    content = _CHUNK.pack(start, end, len(records), crc32(records)) + _text("") + _U64.pack(len(records))
    return b"".join((HEAD.pack(CHUNK, len(content) + len(records)), content, records))


def message_index(channel: int, entries: bytes | bytearray) -> bytes:
    """Pack the index of a channel's messages in the chunk before it; `entries` are packed `INDEX_ENTRY`s."""
    return record(MESSAGE_INDEX, _U16.pack(channel) + _block(entries))


def chunk_index(start: int, end: int, offset: int, length: int, indexes: Mapping[int, int], size: int) -> bytes:
    """Pack the index of a chunk: its times, offset and length in the file, the size of its records, and the offsets
    of its message indexes by channel. These follow the chunk and each other; the end of the last one is channel -1."""
    places = dict(indexes)
    after = places.pop(-1)
    packed = b"".join(_U16.pack(channel) + _U64.pack(at) for channel, at in places.items())
    content = _CHUNK_INDEX.pack(start, end, offset, length) + _block(packed)
    return record(CHUNK_INDEX, content + _U64.pack(after - offset - length) + _text("") + _U64.pack(size) * 2)


def statistics(counts: Mapping[int, int], schemas: int, chunks: int, metadatas: int, start: int, end: int) -> bytes:
    """Numbers of messages by channel, of schemas, chunks and metadata records, and the times between which they are."""
    packed = b"".join(_COUNT.pack(channel, count) for channel, count in counts.items())
    head = _STATISTICS.pack(sum(counts.values()), schemas, len(counts), 0, metadatas, chunks, start, end)
    return record(STATISTICS, head + _block(packed))


def metadata_index(offset: int, length: int, name: str) -> bytes:
    """Pack the index of a metadata record."""
    return record(METADATA_INDEX, _U64.pack(offset) + _U64.pack(length) + _text(name))


def checkpoint(at: int, chunk_indexes: bytes | bytearray, state: bytes) -> bytes:
    """Pack a checkpoint record that stands at `at` in its file: index records of the chunks since the checkpoint
    before it, and `state`, the other records of a summary. Its link to the next checkpoint is 0: none."""
    body = _block(chunk_indexes) + state
    return record(CHECKPOINT, _CHECKPOINT.pack(0, at, _checkpoint_sum(at, body)) + body)


def link(at: int, after: int) -> tuple[int, bytes]:
    """Return offset and bytes of the link that is written into the checkpoint at `at` when the one at `after`
    follows it."""
    return at + HEAD.size, _LINK.pack(after)


def ending(position: int, groups: Iterable[tuple[int, Iterable[bytes]]]) -> Iterator[bytes]:
    """Yield the bytes behind the last chunk of a complete file: the summary, made of `groups` (opcode, pieces of its
    records), and its place. `position` is the offset at which they begin."""
    data_end = record(DATA_END, _U32.pack(0))
    yield data_end
    start = at = position + len(data_end)
    offsets, total = b"", 0
    for opcode, pieces in groups:
        begin = at
        for piece in pieces:
            total = crc32(piece, total)
            at += len(piece)
            yield piece
        if at > begin:
            offsets += record(SUMMARY_OFFSET, bytes((opcode,)) + _U64.pack(begin) + _U64.pack(at - begin))
    covered = offsets + HEAD.pack(FOOTER, _FOOTER.size) + _FOOTER.pack(start, at, 0)[:16]
    yield covered + _U32.pack(crc32(covered, total)) + MAGIC


def _checkpoint_sum(at: int, body: bytes | memoryview) -> int:
    return crc32(body, crc32(_LINK.pack(at)))


def _text(text: str) -> bytes:
    return _block(text.encode())


def _block(data: bytes | bytearray) -> bytes:
    return _U32.pack(len(data)) + data


def _map(entries: Mapping[str, str]) -> bytes:
    return _block(b"".join(_text(key) + _text(value) for key, value in entries.items()))


# What is read


def whole_records(data: bytes | memoryview, at: int = 0) -> Iterator[tuple[int, int, memoryview]]:
    """Offset, opcode and content of each record that is wholly in `data`; stops before the first that is not."""
    view = memoryview(data)
    while at + HEAD.size <= len(view):
        opcode, length = HEAD.unpack_from(view, at)
        if opcode == NOTHING or length > len(view) - at - HEAD.size:
            return
        yield at, opcode, view[at + HEAD.size : at + HEAD.size + length]
        at += HEAD.size + length


def read_schema(content: bytes | memoryview) -> McapSchema:
    """Raises `RecordingError` like all of these, where the content is none."""
    fields = _Fields(content)
    return McapSchema(fields.u16(), fields.text(), fields.text(), fields.block())


def read_channel(content: bytes | memoryview) -> McapChannel:
    """Unpack a channel record."""
    fields = _Fields(content)
    return McapChannel(fields.u16(), fields.u16(), fields.text(), fields.text(), fields.map())


def read_message(content: bytes | memoryview) -> McapMessage:
    """Unpack a message record."""
    if len(content) < _MESSAGE.size:
        raise RecordingError("a message is too short")
    channel, sequence, log_time, _ = _MESSAGE.unpack_from(content)
    return McapMessage(channel, sequence, log_time, bytes(content[_MESSAGE.size :]))


def read_metadata(content: bytes | memoryview) -> tuple[str, dict[str, str]]:
    """Unpack a metadata record into name and entries."""
    fields = _Fields(content)
    return fields.text(), fields.map()


def read_chunk(content: bytes | memoryview) -> Chunk:
    """Unpack a chunk. Where `content` was cut off, `records` are those that are left. The sum is not checked here."""
    fields = _Fields(content)
    start, end, size, crc = (fields.u64(), fields.u64(), fields.u64(), fields.u32())
    compression = fields.text()
    length = fields.u64()
    return Chunk(start, end, size, crc, compression, fields.rest(length))


def read_statistics(content: bytes | memoryview) -> Statistics:
    """Unpack a statistics record."""
    if len(content) < _STATISTICS.size:
        raise RecordingError("a record of statistics is too short")
    _, _, _, _, metadatas, chunks, start, end = _STATISTICS.unpack_from(content)
    packed = _Fields(content[_STATISTICS.size :]).block()
    if len(packed) % _COUNT.size:
        raise RecordingError("a record of statistics has a count that is cut off")
    return Statistics(dict(_COUNT.iter_unpack(packed)), chunks, metadatas, start, end)


def next_checkpoint(at: int, head: bytes) -> int | None:
    """Offset of the checkpoint that follows the one at `at`, whose first `CHECKPOINT_HEAD` bytes are `head`; 0 where
    none follows yet; None where `head` begins no checkpoint of this place."""
    if len(head) < CHECKPOINT_HEAD or head[0] != CHECKPOINT:
        return None
    after, own, _ = _CHECKPOINT.unpack_from(head, HEAD.size)
    return after if own == at else None


def read_checkpoint(at: int, content: bytes) -> tuple[bytes, bytes]:
    """Return the index records of chunks, and the other records of a summary, that the content of a checkpoint at `at`
    holds; raises `RecordingError` where it is none, or damaged."""
    if len(content) < _CHECKPOINT.size:
        raise RecordingError("a checkpoint is too short")
    _, own, total = _CHECKPOINT.unpack_from(content)
    body = memoryview(content)[_CHECKPOINT.size :]
    if own != at or total != _checkpoint_sum(at, body):
        raise RecordingError("the checksum of a checkpoint is wrong")
    fields = _Fields(body)
    return fields.block(), fields.rest(len(body))


class _Fields:
    """Takes one field after the other from a record's content."""

    def __init__(self, content: bytes | memoryview) -> None:
        self._content = memoryview(content)
        self._at = 0

    def u16(self) -> int:
        return int(self._unpack(_U16))

    def u32(self) -> int:
        return int(self._unpack(_U32))

    def u64(self) -> int:
        return int(self._unpack(_U64))

    def block(self) -> bytes:
        length = self.u32()
        if length > len(self._content) - self._at:
            raise RecordingError("a field is longer than its record")
        return self.rest(length)

    def rest(self, most: int) -> bytes:
        data = bytes(self._content[self._at : self._at + most])
        self._at += len(data)
        return data

    def text(self) -> str:
        try:
            return self.block().decode()
        except UnicodeDecodeError:
            raise RecordingError("a text is not UTF-8") from None

    def map(self) -> dict[str, str]:
        fields = _Fields(self.block())
        found = {}
        while fields._at < len(fields._content):
            key = fields.text()
            found[key] = fields.text()
        return found

    def _unpack(self, layout: struct.Struct) -> int:
        if self._at + layout.size > len(self._content):
            raise RecordingError("a record is too short")
        (value,) = layout.unpack_from(self._content, self._at)
        self._at += layout.size
        return int(value)
