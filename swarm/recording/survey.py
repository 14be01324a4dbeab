"""The content of an existing recording, found without reading its messages, so that a restarted process can go on
with it."""

import os

from swarm.errors import RecordingError
from swarm.recording.core import mcap
from swarm.recording.core.writer import ExistingContent, recall

_CHUNK_HEAD = 40
"""Bytes of a chunk record's content before its messages, where they are not compressed."""

_INDEX_HEAD = 6
"""Bytes of a message index before its entries: channel, and length of the entries."""


def survey(file: int, limit: int | None = None) -> ExistingContent:
    """Survey the file up to its last whole record (`position`), or to the end of its data where it was finished.

    What begins at `limit` or behind it is left out. Between two checkpoints that are linked nothing is read, behind the
    last one chunks are stepped over; a chunk whose indexes are not all there counts as not written. Raises
    `RecordingError` for a file that begins differently from one of ours.
    """
    size = os.fstat(file).st_size
    if limit is not None:
        size = min(size, limit)
    if size == 0:
        return ExistingContent()
    known = ExistingContent(len(mcap.MAGIC))
    if os.pread(file, len(mcap.MAGIC), 0) != mcap.MAGIC:
        raise RecordingError("it is no MCAP file")
    chunk: tuple[mcap.Chunk, int] | None = None
    indexes: dict[int, int] = {}
    counts: dict[int, int] = {}

    def close_chunk(at: int) -> None:
        nonlocal chunk
        if chunk is not None:
            head, length = chunk
            known.add_chunk(head.start, head.end, length, {**indexes, -1: at}, head.size)
            for channel, count in counts.items():
                known.counts[channel] = known.counts.get(channel, 0) + count
            chunk = None

    at = known.position
    damaged = False
    while at + mcap.HEAD.size <= size:
        opcode, length = mcap.HEAD.unpack(os.pread(file, mcap.HEAD.size, at))
        inside, after = at + mcap.HEAD.size, at + mcap.HEAD.size + length
        if after > size or opcode == mcap.NOTHING:
            break
        if opcode == mcap.MESSAGE_INDEX and chunk is not None and length >= _INDEX_HEAD:
            (channel,) = mcap.CHANNEL_ID.unpack(os.pread(file, 2, inside))
            indexes[channel] = at
            counts[channel] = (length - _INDEX_HEAD) // mcap.INDEX_ENTRY.size
            at = after
            continue
        close_chunk(at)
        if opcode == mcap.CHUNK:
            head = mcap.read_chunk(os.pread(file, min(length, _CHUNK_HEAD), inside))
            if head.compression or head.size != length - _CHUNK_HEAD:
                raise RecordingError(f"at byte {at}: a chunk of {length} bytes says that it holds {head.size}")
            chunk = head, after - at
            indexes, counts = {}, {}
        elif opcode == mcap.CHECKPOINT:
            # Behind one that is damaged all chunks are stepped over: a later one knows nothing of those before that.
            recalled = None if damaged else _last_checkpoint(file, known, at, size)
            damaged = recalled is None
            known = recalled or known
            known.position = after = max(after, known.position)
        elif opcode in (mcap.DATA_END, mcap.FOOTER):
            break
        elif opcode not in _NOTED:
            known.position += after - at
        elif length > mcap.LARGEST:
            raise RecordingError(f"at byte {at}: a record of {length} bytes: at most {mcap.LARGEST} are read")
        else:
            content = os.pread(file, length, inside)
            if opcode == mcap.METADATA:
                known.add_metadata(after - at, mcap.read_metadata(content)[0])
            else:
                known.describe(opcode, content)
                known.position += after - at
        at = after
    # A chunk at the end may lack indexes of channels; all of ours are written in one go, so it is whole if one is
    # there.
    if chunk is not None and indexes and _complete(file, chunk[0], known.position, counts):
        close_chunk(at)
    return known


_NOTED = frozenset((mcap.METADATA, mcap.SCHEMA, mcap.CHANNEL))
"""Records whose content a process needs that goes on with the file."""


def _last_checkpoint(file: int, known: ExistingContent, at: int, size: int) -> ExistingContent | None:
    """Return the content up to the last checkpoint to which the one at `at` leads; None where `at` has none that is
    whole. A link is only a hint: it may be damaged, or lead to data that was cut off when a process was started
    again."""
    chain: list[int] = []
    while (after := mcap.next_checkpoint(at, os.pread(file, mcap.CHECKPOINT_HEAD, at))) is not None:
        chain.append(at)
        if not at < after < size:
            break
        at = after
    while chain:
        last = chain.pop()
        _, length = mcap.HEAD.unpack(os.pread(file, mcap.HEAD.size, last))
        if length > mcap.LARGEST or last + mcap.HEAD.size + length > size:
            continue
        try:
            return recall(last, os.pread(file, length, last + mcap.HEAD.size), [*known.checkpoints, *chain])
        except RecordingError:
            continue
    return None


def _complete(file: int, chunk: mcap.Chunk, at: int, counts: dict[int, int]) -> bool:
    """Return whether the indexes name as many messages as there are in the chunk at `at`."""
    if chunk.size > mcap.LARGEST:
        return False
    records = os.pread(file, chunk.size, at + mcap.HEAD.size + _CHUNK_HEAD)
    return sum(1 for _, opcode, _ in mcap.whole_records(records) if opcode == mcap.MESSAGE) == sum(counts.values())
