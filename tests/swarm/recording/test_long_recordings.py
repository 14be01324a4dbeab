"""A recording of days: its index leaves the memory, and a process that goes on with it reads little of it."""

import os
from collections import Counter

import pytest
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st

from swarm.recording import file as recording_file
from swarm.recording.core import mcap, writer
from swarm.recording.core.writer import Writer
from swarm.recording.file import RecordingFile
from swarm.recording.reader import RecordingReader
from swarm.recording.survey import survey
from swarm.recording.virtual_file import DirectRecording

TOPICS = tuple(f"swarm/r0/{name}" for name in "abcde")
SMALL = 1000
"""Bytes of chunk indexes between two checkpoints in these tests: some eight chunks."""


@pytest.fixture(autouse=True)
def small_index(monkeypatch):
    monkeypatch.setattr(writer, "INDEX_SIZE", SMALL)
    monkeypatch.setattr(recording_file, "FLUSH_S", 3600.0)  # the test alone writes: one second, one chunk


def written(path, seconds, *, append=False, end=True, journal=None):
    """A recording of five messages a second, each second one chunk."""
    file = RecordingFile(path, Counter(), append=append, min_free=0, journal=journal)
    for t in seconds:
        for topic in TOPICS:
            file.write(topic, float(t), {"i": t})
        file.flush()
    if end:
        file.close()
        return
    file._ending.set()
    file._thread.join()
    os.close(file._file)
    file._file = None


def surveyed(path, limit=None):
    file = os.open(path, os.O_RDONLY)
    try:
        return survey(file, limit)
    finally:
        os.close(file)


def checkpoints(path):
    """Offset and content of each."""
    data = path.read_bytes()
    return [
        (at, bytes(content))
        for at, opcode, content in mcap.whole_records(data, len(mcap.MAGIC))
        if opcode == mcap.CHECKPOINT
    ]


def relinked(data, at, after):
    """A recording in which the checkpoint at `at` says that the next one stands at `after`."""
    place, link = mcap.link(at, after)
    return data[:place] + link + data[place + len(link) :]


def check_with_the_other_reader(path, seconds):
    """The index names every message, the checksums are right: read by the package of the format's authors."""
    reader = pytest.importorskip("mcap.reader")
    with path.open("rb") as stream:
        seeking = reader.SeekingReader(stream, validate_crcs=True)
        summary = seeking.get_summary()
        assert summary.statistics.message_count == seconds * len(TOPICS)
        assert summary.statistics.chunk_count == len(summary.chunk_indexes) == seconds
        assert len(list(seeking.iter_messages())) == seconds * len(TOPICS)
        late = [message.log_time for _, _, message in seeking.iter_messages(topics=[TOPICS[2]])]
        assert len(late) == seconds


def test_the_index_of_a_long_recording_is_in_the_file_not_in_memory(tmp_path):
    path = tmp_path / "x.mcap"
    written(path, range(200))
    assert len(checkpoints(path)) > 10
    check_with_the_other_reader(path, 200)
    reader = RecordingReader(path)
    assert [sample.message["i"] for sample in reader.samples(TOPICS[0].__eq__)] == list(range(200))
    assert (reader.finished, reader.damage) == (True, [])


def test_a_recording_under_virtual_time_keeps_its_index_in_the_file_too(tmp_path):
    path = tmp_path / "x.mcap"
    file = DirectRecording(path, {"app": "x"})
    for t in range(201):
        for topic in TOPICS:
            file.write(topic, float(t), {"i": t})
    file.close()
    check_with_the_other_reader(path, 201)
    assert len(checkpoints(path)) > 10


def test_a_writer_keeps_no_more_of_the_index_than_goes_into_a_checkpoint():
    writer = Writer("test", epoch_ns=0)
    most = 0
    for t in range(300):
        for topic in TOPICS:
            writer.write(topic, float(t), {"i": t})
        writer.take()
        most = max(most, len(writer._known.chunk_indexes))
    assert most < SMALL + 200
    assert len(writer.checkpoints) > 20


def reads(path, monkeypatch):
    """Bytes that a process reads before it goes on with a recording."""
    read = 0
    pread = os.pread

    def count(file, length, at):
        nonlocal read
        data = pread(file, length, at)
        read += len(data)
        return data

    monkeypatch.setattr(os, "pread", count)
    surveyed(path)
    monkeypatch.undo()
    monkeypatch.setattr(writer, "INDEX_SIZE", SMALL)
    return read


def test_a_process_that_goes_on_with_a_long_recording_reads_little_of_it(tmp_path, monkeypatch):
    written(tmp_path / "short.mcap", range(30), end=False)
    written(tmp_path / "long.mcap", range(300), end=False)
    links = len(checkpoints(tmp_path / "long.mcap")) * mcap.CHECKPOINT_HEAD
    # Not more than what one checkpoint and the chunks behind it may differ by, and the links.
    assert reads(tmp_path / "long.mcap", monkeypatch) < reads(tmp_path / "short.mcap", monkeypatch) + links + 4 * SMALL


def test_a_recording_that_was_gone_on_with_often_is_whole(tmp_path):
    path = tmp_path / "x.mcap"
    for start in range(10):
        written(path, range(20 * start, 20 * start + 20), append=start > 0, end=start % 2 == 0, journal=tmp_path / "j")
    written(path, range(200, 201), append=True)
    check_with_the_other_reader(path, 201)


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """A recording with checkpoints and no end, and the same without links between them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "INDEX_SIZE", SMALL)
        patch.setattr(recording_file, "FLUSH_S", 3600.0)
        path = tmp_path_factory.mktemp("killed") / "x.mcap"
        written(path, range(60), end=False)
        unlinked = path.read_bytes()
        for at, _ in checkpoints(path):
            unlinked = relinked(unlinked, at, 0)
        other = path.with_name("unlinked.mcap")
        other.write_bytes(unlinked)
        return path, other


def test_each_checkpoint_of_a_recording_leads_to_the_next(killed):
    linked, unlinked = killed
    found = [at for at, _ in checkpoints(linked)]
    heads = [mcap.next_checkpoint(at, linked.read_bytes()[at : at + mcap.CHECKPOINT_HEAD]) for at in found]
    assert heads == [*found[1:], 0]
    assert surveyed(linked).checkpoints == surveyed(unlinked).checkpoints == found


@given(st.data())
def test_a_survey_finds_the_same_with_and_without_links_wherever_the_file_ends(killed, data):
    linked, unlinked = killed
    limit = data.draw(st.integers(0, linked.stat().st_size))
    assert surveyed(linked, limit) == surveyed(unlinked, limit)


def test_a_checkpoint_that_says_it_stands_elsewhere_costs_no_entry_of_the_index(killed, tmp_path):
    linked, _ = killed
    for number, (at, _) in enumerate(checkpoints(linked)):
        damaged = bytearray(linked.read_bytes())
        damaged[at + mcap.HEAD.size + 8] ^= 1
        path = tmp_path / f"{number}.mcap"
        path.write_bytes(damaged)
        written(path, range(60, 70), append=True)
        check_with_the_other_reader(path, 70)


def test_a_link_that_leads_past_a_checkpoint_leaves_no_index_that_lacks_chunks(killed, tmp_path):
    linked, _ = killed
    places = [at for at, _ in checkpoints(linked)]
    path = tmp_path / "x.mcap"
    path.write_bytes(relinked(linked.read_bytes(), places[0], places[2]))
    written(path, range(60, 70), append=True)
    reader = RecordingReader(path)
    assert [sample.message["i"] for sample in reader.samples(TOPICS[0].__eq__)] == list(range(70))
    assert not reader.finished


@pytest.mark.parametrize("link", [1 << 62, (1 << 63) - 1, 1 << 63, (1 << 64) - 1])
def test_a_link_out_of_the_file_leads_nowhere(killed, tmp_path, link):
    linked, _ = killed
    whole = surveyed(linked)
    for number, (at, _) in enumerate(checkpoints(linked)):
        path = tmp_path / f"{number}.mcap"
        path.write_bytes(relinked(linked.read_bytes(), at, link))
        found = surveyed(path)
        assert (found.position, found.counts, found.chunks) == (whole.position, whole.counts, whole.chunks)


@costly(40)
@given(st.data())
def test_a_damaged_checkpoint_costs_no_message(killed, tmp_path_factory, data):
    linked, _ = killed
    whole = surveyed(linked)
    at, content = data.draw(st.sampled_from(checkpoints(linked)))
    damaged = bytearray(linked.read_bytes())
    place = data.draw(st.integers(at + mcap.HEAD.size, at + mcap.HEAD.size + len(content) - 1))
    damaged[place] ^= data.draw(st.integers(1, 255))
    path = tmp_path_factory.mktemp("damaged") / "x.mcap"
    path.write_bytes(damaged)
    found = surveyed(path)
    assert (found.position, found.counts, found.chunks) == (whole.position, whole.counts, whole.chunks)
    written(path, range(60, 70), append=True)
    reader = RecordingReader(path)
    assert [sample.message["i"] for sample in reader.samples(TOPICS[0].__eq__)] == list(range(70))
    if reader.finished:  # damage to the index itself leaves the file without one
        assert reader.damage == []
        check_with_the_other_reader(path, 70)
