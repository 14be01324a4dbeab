"""Recordings that are cut off, damaged, or none at all: what is whole is read, the rest is named."""

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from swarm.errors import RecordingError
from swarm.recording.core.writer import Writer
from swarm.recording.reader import RecordingReader


def recording():
    """Two topics in three chunks; the offset behind each chunk, and how many messages are there by then."""
    writer = Writer("test", epoch_ns=0)
    writer.metadata("run", {"app": "x"})
    data, marks = b"", []
    for i in range(6):
        writer.write("ab"[i % 2], 0.1 * i, {"i": i})
        if i % 2:
            writer.cut()
            data += writer.take()
            marks.append((len(data), i + 1))
    return data + b"".join(writer.finish()), marks


def read(path):
    reader = RecordingReader(path)
    return [sample.message["i"] for sample in reader.samples()], reader


def test_cut_off_anywhere_what_is_whole_is_read(tmp_path):
    data, marks = recording()
    path = tmp_path / "x.mcap"
    for size in range(len(data) + 1):
        path.write_bytes(data[:size])
        found, reader = read(path)
        assert found == list(range(len(found)))
        assert len(found) >= max((count for at, count in marks if at <= size), default=0)
        assert reader.finished == (size == len(data))
        assert all(text.startswith(f"{path}: at byte ") for text in reader.damage)
        assert all("cut off" in text or "only begun" in text for text in reader.damage)
    assert read(path)[0] == list(range(6))


@given(st.data())
def test_a_flipped_byte_is_read_around_or_named(tmp_path_factory, draw):
    data, _ = recording()
    at = draw.draw(st.integers(0, len(data) - 1))
    damaged = bytearray(data)
    damaged[at] ^= draw.draw(st.integers(1, 255))
    path = tmp_path_factory.mktemp("r") / "x.mcap"
    path.write_bytes(damaged)
    try:
        found, _ = read(path)
    except (RecordingError, KeyError):
        return
    assert set(found) <= set(range(6)) or len(found) <= 6


@given(st.binary(max_size=300))
@example(b"\x06" + (2**63).to_bytes(8, "little"))
@example(b"\x06" + (3).to_bytes(8, "little") + b"abc")
def test_any_bytes_are_read_or_refused(tmp_path_factory, junk):
    path = tmp_path_factory.mktemp("r") / "x.mcap"
    for data in (junk, b"\x89MCAP0\r\n" + junk, recording()[0][:300] + junk):
        path.write_bytes(data)
        try:
            reader = RecordingReader(path)
            for sample in reader.samples():
                sample.message  # noqa: B018
        except RecordingError:
            pass


def test_a_damaged_chunk_is_named_and_the_others_are_read(tmp_path):
    data, marks = recording()
    damaged = bytearray(data)
    at = data.index(b'{"i":2}')
    damaged[at + 5] = ord("9")
    path = tmp_path / "x.mcap"
    path.write_bytes(damaged)
    found, reader = read(path)
    assert found == [0, 1, 4, 5]
    assert len(reader.damage) == 1
    assert f"at byte {marks[0][0]}: the checksum of a chunk" in reader.damage[0]


def test_what_is_no_recording_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="cannot be read: No such file"):
        RecordingReader(tmp_path / "none.mcap")
    (tmp_path / "x.mcap").write_text("k,t,value\n")
    with pytest.raises(RecordingError, match="it is no MCAP file"):
        RecordingReader(tmp_path / "x.mcap")
    with pytest.raises(RecordingError, match="cannot be read: Is a directory"):
        RecordingReader(tmp_path)
