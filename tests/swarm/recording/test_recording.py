"""The writer's bytes: as the format has them, equal for equal messages, and readable by others."""

import importlib
import io
import json
import os
import struct
import zlib
from enum import Enum

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.errors import LocalError
from swarm.messages import AppParameter, AppParameters, AppState, Links, LinkState, Pose
from swarm.recording.core import json_text, mcap
from swarm.recording.core.writer import CHUNK_SIZE, Writer
from swarm.recording.reader import RecordingReader

POSE = Pose(2.5, 7, 1.25, -0.5, None, 90, "ekf", 0.02, 0.03, 0.1)


class Phase(Enum):
    LEFT = 0
    RIGHT = 1


def recorded(*messages, epoch_ns=0, finish=True):
    """Bytes of (topic, t, message)."""
    writer = Writer("test", epoch_ns=epoch_ns)
    writer.metadata("run", {"app": "x", "epoch_ns": str(epoch_ns)})
    for topic, t, message in messages:
        writer.write(topic, t, message)
    if finish:
        return b"".join(writer.finish())
    writer.cut()
    return writer.take()


def read(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("r") / "x.mcap"
    path.write_bytes(data)
    reader = RecordingReader(path)
    return list(reader.samples()), reader


def test_a_recording_has_these_bytes():
    data = recorded(("a/b", 1.5, {"v": 0.1}), epoch_ns=1_000, finish=False)
    schema = b'{"title":"swarm.dict","type":"object","properties":{"v":{"type":"number"}}}'
    message = b'{"v":0.1}'
    expected = b"\x89MCAP0\r\n"
    expected += b"\x01" + struct.pack("<Q", 12) + struct.pack("<I", 0) + struct.pack("<I", 4) + b"test"
    entries = b"\x03\0\0\0app\x01\0\0\0x\x08\0\0\0epoch_ns\x04\0\0\0001000"
    expected += b"\x0c" + struct.pack("<QI", 11 + len(entries), 3) + b"run" + struct.pack("<I", len(entries)) + entries
    body = b"\x01\0" + b"\x0a\0\0\0swarm.dict" + b"\x0a\0\0\0jsonschema" + struct.pack("<I", len(schema)) + schema
    expected += b"\x03" + struct.pack("<Q", len(body)) + body
    body = b"\x01\0\x01\0" + b"\x03\0\0\0a/b" + b"\x04\0\0\0json" + b"\0\0\0\0"
    expected += b"\x04" + struct.pack("<Q", len(body)) + body
    inner = b"\x05" + struct.pack("<QHIQQ", 22 + len(message), 1, 1, 1_500_001_000, 1_500_001_000) + message
    body = struct.pack("<QQQI", 1_500_001_000, 1_500_001_000, len(inner), zlib.crc32(inner)) + b"\0\0\0\0"
    body += struct.pack("<Q", len(inner)) + inner
    expected += b"\x06" + struct.pack("<Q", len(body)) + body
    expected += b"\x07" + struct.pack("<QHIQQ", 22, 1, 16, 1_500_001_000, 0)
    assert data == expected


def test_another_reader_reads_it():
    """The `mcap` package, written by the format's authors: messages, index, statistics and checksums."""
    reader = other_reader()
    messages = [("swarm/r0/x", 0.25 * i, {"i": i, "x": i / 3}) for i in range(40)]
    messages += [("swarm/r1/y", 3.0, {"text": "ü"}), ("swarm/r0/dwm/pose", 2.5, POSE)]
    data = recorded(*messages, epoch_ns=5)
    seeking = reader.SeekingReader(io.BytesIO(data), validate_crcs=True)
    assert seeking.get_header().library == "test"
    summary = seeking.get_summary()
    assert summary.statistics.message_count == len(messages)
    assert summary.statistics.message_start_time == 5
    assert summary.statistics.message_end_time == 9_750_000_005
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 5
    assert {channel.topic for channel in summary.channels.values()} == {topic for topic, _, _ in messages}
    found = [(channel.topic, message.log_time, message.data) for _, channel, message in seeking.iter_messages()]
    assert (
        sorted(found)[:5]
        == sorted(
            (topic, 5 + round(t * 1e9), message.data)
            for topic, t, message in (
                (t, w, type("M", (), {"data": foxglove(m, 5 + round(w * 1e9))})) for t, w, m in messages
            )
        )[:5]
    )
    assert len(found) == len(messages)
    only = list(seeking.iter_messages(topics=["swarm/r1/y"], starting_at=2_000_000_000))
    assert [json.loads(message.data) for _, _, message in only] == [{"text": "ü"}]
    assert [(it.name, it.metadata) for it in seeking.iter_metadata()] == [("run", {"app": "x", "epoch_ns": "5"})]
    streaming = reader.NonSeekingReader(io.BytesIO(data), validate_crcs=True)
    assert len(list(streaming.iter_messages())) == len(messages)


def other_reader():
    """CI has it (requirements-dev.lock)."""
    return importlib.import_module("mcap.reader") if os.environ.get("CI") else pytest.importorskip("mcap.reader")


def foxglove(message, log_time):
    from swarm.recording.core import foxglove as module

    return module.pose(message, log_time) if isinstance(message, Pose) else json_text.encode(message)


def test_a_pose_is_one_that_foxglove_draws(tmp_path_factory):
    (sample,), reader = read(tmp_path_factory, recorded(("swarm/r0/dwm/pose", 2.5, POSE), epoch_ns=3_000_000_001))
    assert reader.schemas[1].name == "foxglove.PoseInFrame"
    shape = json.loads(reader.schemas[1].data)
    assert set(sample.message) <= set(shape["properties"])
    assert sample.message["timestamp"] == {"sec": 5, "nsec": 500_000_001}
    assert sample.message["pose"]["position"] == {"x": 1.25, "y": -0.5, "z": 0.0}
    assert sample.message["pose"]["orientation"] == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    assert (sample.message["deviation_x"], sample.t) == (0.02, 2.5)
    assert "heading" not in sample.message


VALUES = st.one_of(st.floats(allow_nan=False), st.integers(-(2**70), 2**70), st.booleans(), st.text(),
                   st.lists(st.floats(allow_nan=False), max_size=4).map(tuple))  # fmt: skip
STATES = st.dictionaries(st.text(min_size=1), VALUES, max_size=5)


@given(st.lists(st.tuples(st.sampled_from("abc"), st.floats(0, 1e6), STATES), max_size=20))
def test_what_was_written_is_read(tmp_path_factory, messages):
    data = recorded(*((topic, t, AppState(t, 3, state, {})) for topic, t, state in messages))
    samples, reader = read(tmp_path_factory, data)
    assert reader.finished
    assert reader.damage == []
    assert [(s.topic, s.message["t"], s.message["state"]) for s in samples] == messages
    # Equal is not enough: the bits must be.
    assert repr([s.message["state"] for s in samples]) == repr([state for _, _, state in messages])
    assert data == recorded(*((topic, t, AppState(t, 3, state, {})) for topic, t, state in messages))


def test_numbers_that_json_has_not():
    state = {"a": float("inf"), "b": -float("inf"), "c": float("nan"), "d": (1.0, float("nan")), "e": 'x"y'}
    text = json_text.encode(AppState(1.0, 0, state, {}))
    assert text == b'{"t":1.0,"k":0,"state":{"a":1e999,"b":-1e999,"c":null,"d":[1.0,null],"e":"x\\"y"},"result":{}}'
    assert json_text.decode(text)["state"] == {"a": float("inf"), "b": -float("inf"), "c": None, "d": (1.0, None),
                                              "e": 'x"y'}  # fmt: skip


def test_enumerations_go_by_name_and_bytes_as_base64():
    assert json_text.encode({"phase": Phase.RIGHT, "raw": b"\xff\x00"}) == b'{"phase":"RIGHT","raw":"/wA="}'
    with pytest.raises(LocalError, match="cannot be recorded: a set has no form in JSON"):
        json_text.encode({"x": {1}})
    circle = []
    circle.append(circle)
    with pytest.raises(LocalError, match="cannot be recorded"):
        json_text.encode({"x": circle})


def test_schemas_say_what_the_fields_are():
    shape = json.loads(json_text.schema(AppState(0.0, 1, {"q": (1.0,), "n": 2}, {"on": True}), "x.State"))
    assert shape["properties"]["k"] == {"type": "integer"}
    assert shape["properties"]["state"]["properties"] == {
        "q": {"type": "array", "items": {"type": "number"}}, "n": {"type": "integer"}}  # fmt: skip
    assert shape["properties"]["result"]["properties"] == {"on": {"type": "boolean"}}
    shape = json.loads(json_text.schema(Links(0.0, ()), "swarm.Links"))
    assert shape["properties"]["links"]["items"]["properties"].keys() == set(LinkState.__slots__)
    parameters = {
        "weights": AppParameter("row", "", "a text", live=False),
        "gain": AppParameter(1.0, "", "", live=True),
    }
    shape = json.loads(json_text.schema(AppParameters(0.0, parameters), "swarm.AppParameters"))
    shapes = shape["properties"]["parameters"]["properties"]
    assert {name: each["properties"]["value"]["type"] for name, each in shapes.items()} == {
        "weights": "string", "gain": "number"}  # fmt: skip


def test_chunks_end_by_size_and_by_the_messages_own_time():
    writer = Writer("test", epoch_ns=0)
    writer.take()
    for i in range(9):
        writer.write("a", 0.1 * i, {"i": i})
    assert [opcode for _, opcode, _ in mcap.whole_records(writer.take())] == [mcap.SCHEMA, mcap.CHANNEL]
    writer.write("a", 1.0, {"i": 10})
    assert [opcode for _, opcode, _ in mcap.whole_records(writer.take())] == [mcap.CHUNK, mcap.MESSAGE_INDEX]
    for _ in range(CHUNK_SIZE // 1000 + 2):
        writer.write("a", 1.0, {"text": "x" * 1000})
    assert len(writer.take()) > CHUNK_SIZE
    assert writer.waiting < CHUNK_SIZE // 10
