"""A damaged recording that a process is to go on with: named, and never read into memory by a length that it claims."""

import os
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_reader import recording

from swarm.errors import RecordingError
from swarm.recording.core import mcap
from swarm.recording.core.writer import ExistingContent
from swarm.recording.reader import RecordingReader
from swarm.recording.survey import survey

LARGE = 300 * 1024 * 1024
MIB = 1024 * 1024


def surveyed(path, data: bytes, size: int | None = None) -> ExistingContent:
    path.write_bytes(data)
    file = os.open(path, os.O_RDWR)
    try:
        if size is not None:
            os.ftruncate(file, size)  # zeros that take no room on the disk
        return survey(file)
    finally:
        os.close(file)


@pytest.mark.parametrize("opcode", [mcap.METADATA, mcap.SCHEMA, mcap.CHANNEL, mcap.CHUNK])
def test_a_record_of_300_megabytes_is_not_read_into_memory(tmp_path, opcode):
    data = mcap.MAGIC + mcap.HEAD.pack(opcode, LARGE - len(mcap.MAGIC) - mcap.HEAD.size)
    tracemalloc.start()
    try:
        with pytest.raises(RecordingError, match="at byte 8"):
            surveyed(tmp_path / "x.mcap", data, LARGE)
        assert tracemalloc.get_traced_memory()[1] < MIB
    finally:
        tracemalloc.stop()


def test_a_chunk_whose_size_is_not_that_of_its_record_is_named_and_not_read(tmp_path):
    data, _ = recording()
    offsets = [start for start, opcode, _ in mcap.whole_records(data[:-8], 8) if opcode == mcap.CHUNK]
    at = offsets[-1] + mcap.HEAD.size + 16
    wrong = data[:at] + (1 << 62).to_bytes(8, "little") + data[at + 8 :]
    with pytest.raises(RecordingError, match="says that it holds 4611686018427387904"):
        surveyed(tmp_path / "x.mcap", wrong)


def test_an_index_without_a_channel_at_the_end_of_the_file_is_left_out(tmp_path):
    data, marks = recording()
    whole = surveyed(tmp_path / "x.mcap", data[: marks[-1][0]])
    cut = data[: marks[-1][0]] + mcap.HEAD.pack(mcap.MESSAGE_INDEX, 0)
    assert surveyed(tmp_path / "x.mcap", cut).counts == whole.counts


@given(st.data())
def test_damaged_bytes_are_named_or_left_out(tmp_path_factory, draw):
    data, _ = recording()
    damaged = bytearray(data)
    for _ in range(draw.draw(st.integers(1, 3))):
        at = draw.draw(st.integers(8, len(data) - 1))
        damaged[at : at + 8] = draw.draw(st.binary(max_size=9))
    try:
        known = surveyed(
            tmp_path_factory.mktemp("r") / "x.mcap", bytes(damaged[: draw.draw(st.integers(8, len(data)))])
        )
    except RecordingError:
        return
    assert 0 <= known.position <= len(damaged)


@pytest.mark.parametrize("epoch", ["9" * 5000, "9" * 400, "-" + "9" * 30, "x"])
def test_a_clock_beyond_64_bits_is_named(tmp_path, epoch):
    """It did not fit a float, and the error was none that readers of recordings take."""
    data, _ = recording()
    begin = mcap.MAGIC + mcap.metadata("run", {"epoch_ns": epoch})
    (tmp_path / "x.mcap").write_bytes(begin + data[8:])
    reader = RecordingReader(tmp_path / "x.mcap")
    assert len(list(reader.samples())) == 6
    assert any("64 bits" in text for text in reader.damage)


def test_zeros_that_a_power_cut_has_left_are_the_end(tmp_path):
    """Each nine of them were taken for an empty record: 100 MB took a restarted app half a minute."""
    data, marks = recording()
    whole = surveyed(tmp_path / "x.mcap", data[: marks[-1][0]])
    known = surveyed(tmp_path / "x.mcap", data[: marks[-1][0]], LARGE)
    assert (known.position, known.counts) == (marks[-1][0], whole.counts)
    reader = RecordingReader(tmp_path / "x.mcap")
    assert len(list(reader.samples())) == 6
    assert "cut off" in reader.damage[0]
