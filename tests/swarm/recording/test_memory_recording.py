"""A recording that is held in memory reads as from its file, and its file has the bytes of one written at once."""

import math
from pathlib import Path
from unittest.mock import Mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.errors import LocalError
from swarm.messages import AppProgress, Clock, Pose
from swarm.recording import memory_recording
from swarm.recording.memory_recording import MemoryRecording
from swarm.recording.run import Run
from swarm.recording.virtual_file import DirectRecording

RUN = {"app": "x", "run": "1f"}
FINITE = st.floats(-1e9, 1e9)
NUMBERS = st.floats() | st.integers(-(1 << 63), (1 << 63) - 1) | st.booleans()
VALUES = NUMBERS | st.text(st.characters()) | st.lists(st.floats()).map(tuple)
STATES = st.builds(
    lambda k, state, result: {"t": 0.5, "k": k, "state": state, "result": result},
    st.integers(0, 9),
    st.fixed_dictionaries({"v": VALUES}),
    st.dictionaries(st.text(), VALUES, max_size=2),
)
POSES = st.builds(
    Pose, FINITE, st.just(1), FINITE, FINITE, st.none() | FINITE, st.just(50), st.sampled_from(["ekf", "module"])
)
MESSAGES = st.one_of(
    st.tuples(st.sampled_from(["r0/app/x/state", "r1/app/x/state", "r1/app/x/phase/state"]), STATES),
    st.tuples(st.just("r0/dwm/pose"), POSES),
    st.tuples(st.just("r0/app/x/progress"), st.just(AppProgress(0.5, "starting", 0, ("r1",), ""))),
    st.tuples(st.just("r1/mesh/clock"), st.just(Clock(0.5, 7.0, 0.0, "r0", 0, 0.001))),
)
RECORDS = st.lists(st.tuples(st.floats(0, 1e4), MESSAGES) | st.dictionaries(st.text(), st.text(), max_size=2))


def record(file: DirectRecording | MemoryRecording, records: list[object]) -> None:
    for each in records:
        if isinstance(each, dict):
            file.metadata("outcome", each)
        else:
            t, (topic, message) = each  # type: ignore[misc]
            file.write(f"swarm/{topic}", t, message, "x.state" if topic.endswith("state") else "")
    file.close()


def content(run: Run) -> object:
    """All that a run is asked for; by repr, so that nan equals nan and -0.0 is not 0.0."""
    return repr(
        (
            run.info,
            run.topics,
            run.origin,
            run.basis,
            run.damage,
            run.notes("outcome"),
            run.notes("run"),
            {topic: (schema.name, schema.encoding, schema.data) for topic, schema in run.schemas.items()},
            [(each.topic, each.t, each.data, each.message) for each in run.samples()],
        )
    )


@given(RECORDS)
def test_a_recording_in_memory_reads_as_its_file_and_has_its_bytes(tmp_path_factory, records):
    folder = tmp_path_factory.mktemp("recordings")
    direct, path = folder / "direct" / "x.mcap", folder / "later" / "x.mcap"
    for each in (direct, path):
        each.parent.mkdir()
    record(DirectRecording(direct, RUN), records)
    recording = MemoryRecording(path, RUN)
    record(recording, records)
    before = content(Run(path, in_memory={path: recording}))
    assert not path.exists()
    recording.write_out()
    assert path.read_bytes() == direct.read_bytes()
    assert content(Run(path, in_memory={path: recording})) == content(Run(path)) == before


def state(k: int) -> dict[str, object]:
    return {
        "t": float(k),
        "k": k,
        "state": {"v": -0.0 if k else math.pi},
        "result": {"far": math.inf, "error": math.nan},
    }


def states_in_memory(path: Path, count: int) -> MemoryRecording:
    recording = MemoryRecording(path, RUN)
    for k in range(count):
        recording.write("swarm/r0/app/x/state", float(k), state(k))
    return recording


def test_a_long_recording_goes_on_in_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_recording, "MOST", 10)
    path = tmp_path / "x.mcap"
    recording = states_in_memory(path, 25)
    assert path.exists()
    recording.metadata("outcome", {"messages": "3"})
    recording.close()
    run = Run(path, in_memory={path: recording})
    assert run.trajectories()["r0"].rows[24] == ("-0.0", "inf", "nan")
    assert run.notes("outcome") == [{"messages": "3"}]
    assert run.damage == []


def test_older_recordings_make_room_for_new_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_recording, "MOST", 10)
    monkeypatch.setattr(memory_recording, "_ended", [])
    recordings = {}
    for name in ("a", "b", "c"):
        path = tmp_path / f"{name}.mcap"
        recordings[path] = states_in_memory(path, 4)
        recordings[path].close()
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["a.mcap"]
    for path, recording in recordings.items():
        rows = Run(path, in_memory={path: recording}).trajectories()["r0"].rows
        assert (len(rows), rows[3]) == (4, ("-0.0", "inf", "nan"))
    recordings.clear()
    del recording
    assert memory_recording._ended == []


def test_a_recording_that_cannot_be_written_is_still_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "later" / "x.mcap"
    recording = states_in_memory(path, 3)
    recording.close()
    with pytest.raises(LocalError, match="cannot be written: No such file"):
        recording.write_out()
    path.parent.mkdir()
    with monkeypatch.context() as disk:
        disk.setattr(DirectRecording, "close", Mock(side_effect=LocalError("the disk is full")))
        with pytest.raises(LocalError, match="disk is full"):
            recording.write_out()
    assert len(Run(path, in_memory={path: recording}).trajectories()["r0"].rows) == 3
    recording.write_out()
    assert len(Run(path).trajectories()["r0"].rows) == 3
