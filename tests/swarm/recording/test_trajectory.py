import math

import pytest

from swarm.core.percentile import percentile
from swarm.errors import RecordingError
from swarm.messages import AppEpoch, AppState
from swarm.recording import trajectory
from swarm.recording.core.writer import Writer
from swarm.recording.reader import SHAPES

TOPIC = "swarm/r0/app/consensus/state"


def write(tmp_path, *rows, topic=TOPIC, shapes=None):
    """A recording with states of (k, t, state, result)."""
    writer = Writer("test", epoch_ns=0)
    if shapes:
        writer.metadata(SHAPES, shapes)
    for k, t, state, result in rows:
        writer.write(topic, t, AppState(t, k, state, result), "consensus.State")
    path = tmp_path / "r0.consensus.mcap"
    path.write_bytes(b"".join(writer.finish()))
    return path


def value(k, t, number):
    return k, t, {"value": number}, {"value": number}


def test_reads_what_a_host_writes(tmp_path):
    found = trajectory.read(write(tmp_path, value(0, 10.0, 0.5), value(1, 10.03, 1.25)))
    assert found.columns == ("value", "result.value")
    assert found.last == 1
    assert found.value(1, "value") == 1.25
    assert found.first_reached() == 10.03


def test_every_kind_of_value_has_its_columns(tmp_path):
    state = {"q": (0.1 + 0.2, -0.0), "m": (1.0, 2.0, 3.0, 4.0), "n": 3, "on": True, "who": 'say "a, b"'}
    found = trajectory.read(write(tmp_path, (0, 1.0, state, {}), shapes={"m": "2x2", "q": "2x2", "n": "x"}))
    assert found.columns == ("q[0]", "q[1]", "m[0,0]", "m[0,1]", "m[1,0]", "m[1,1]", "n", "on", "who")
    assert found.rows[0] == ("0.30000000000000004", "-0.0", "1.0", "2.0", "3.0", "4.0", "3", "True", 'say "a, b"')


def test_a_repeated_iteration_must_be_equal(tmp_path):
    again = trajectory.read(write(tmp_path, value(3, 10.0, 0.5), value(3, 11.0, 0.5)))
    assert again.times[3] == again.newest == 10.0
    with pytest.raises(RecordingError, match=r"iteration 3 stands there twice"):
        trajectory.read(write(tmp_path, value(3, 10.0, 0.0), value(3, 11.0, -0.0)))


def test_the_result_of_a_repeated_iteration_may_differ(tmp_path):
    """After a restart the robot has moved, a parameter has changed, or the truth is not known yet."""
    first = {"value": 0.5, "gain": 0.75, "error": 0.25}
    later = {"value": 0.5, "gain": 0.5, "error": None}
    found = trajectory.read(write(tmp_path, (3, 10.0, {"value": 0.5}, first), (3, 11.0, {"value": 0.5}, later)))
    assert [found.value(3, f"result.{name}") for name in first] == [0.5, 0.75, 0.25]
    with pytest.raises(RecordingError, match=r"iteration 3 stands there twice"):
        trajectory.read(write(tmp_path, (3, 10.0, {"value": 0.5}, first), (3, 11.0, {"value": 0.75}, later)))


def test_what_is_done_again_with_other_members_counts_from_then_on(tmp_path):
    writer = Writer("test", epoch_ns=0)
    for k, value_of_it in ((0, 0.0), (1, 1.0), (2, 2.0), (3, 3.0)):
        writer.write(TOPIC, float(k), AppState(float(k), k, {"value": value_of_it}, {}))
    epoch = AppEpoch(4.0, 1, 1, ("r0",), (("r0", "r1"),), (), forced=False, frames=7)
    writer.write("swarm/r0/app/consensus/epoch", 4.0, epoch)
    for k, value_of_it in ((1, 1.0), (2, 2.5)):
        writer.write(TOPIC, 4.0 + k, AppState(4.0 + k, k, {"value": value_of_it}, {}))
    path = tmp_path / "epochs.mcap"
    path.write_bytes(b"".join(writer.finish()))
    found = trajectory.read(path)
    assert [found.rows[k] for k in sorted(found.rows)] == [("0.0",), ("1.0",), ("2.5",)]
    assert found.times == {0: 0.0, 1: 5.0, 2: 6.0}


def test_a_state_has_the_same_fields_throughout(tmp_path):
    with pytest.raises(RecordingError, match=r"iteration 1 has other fields than the first: v"):
        trajectory.read(write(tmp_path, (0, 1.0, {"u": 1.0}, {}), (1, 2.0, {"v": 1.0}, {})))


def test_what_is_no_state_is_refused(tmp_path):
    writer = Writer("test", epoch_ns=0)
    writer.write(TOPIC, 1.0, {"k": "one"})
    (tmp_path / "x.mcap").write_bytes(b"".join(writer.finish()))
    with pytest.raises(RecordingError, match="a state without k, t, state and result"):
        trajectory.read(tmp_path / "x.mcap")


def test_a_trajectory_reader_goes_on_with_a_file_that_grows(tmp_path):
    whole = write(tmp_path, value(0, 1.0, 0.5), value(1, 2.0, 1.5), value(2, 3.0, 2.5)).read_bytes()
    path = tmp_path / "growing.mcap"
    reader = trajectory.TrajectoryReader(path)
    assert reader.read().last == -1
    seen = []
    for size in range(len(whole) + 1):
        path.write_bytes(whole[:size])
        seen.append(reader.read().last)
    assert seen == sorted(seen)
    assert reader.read().rows == trajectory.read(tmp_path / "r0.consensus.mcap").rows


def test_nothing_recorded_is_empty(tmp_path):
    assert trajectory.read(tmp_path / "absent.mcap").last == -1
    assert trajectory.EMPTY.newest == -math.inf
    assert trajectory.read(write(tmp_path)).last == -1
    (tmp_path / "empty.mcap").write_bytes(b"")
    assert trajectory.read(tmp_path / "empty.mcap").last == -1


def test_iterations_are_measured_over_windows_because_lockstep_alternates():
    # 2 ms and 64 ms in turn: a median of single intervals would say 2 or 64, the rate is 33 ms.
    times, t = {}, 0.0
    for k in range(60):
        times[k] = t
        t += 0.002 if k % 2 else 0.064
    values = trajectory.iteration_times({"r0": trajectory.Trajectory((), times, {})})
    assert trajectory.median(values) == pytest.approx(0.033)
    assert percentile(values, 95) == pytest.approx(0.033)


def test_of_a_long_run_that_is_only_measured_the_newest_states_and_some_times_are_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(trajectory, "MOST_ROWS", 100)
    monkeypatch.setattr(trajectory, "MOST_TIMES", 200)
    rows = [(k, 0.1 * k, {"value": float(k)}, {}) for k in range(5000)]
    path = write(tmp_path, *rows)
    whole, found = trajectory.read(path), trajectory.read(path, whole=False)
    assert (found.last, found.newest, found.columns) == (whole.last, whole.newest, whole.columns)
    assert 100 <= len(found.rows) <= 201
    assert len(found.times) <= 401
    assert found.rows.items() <= whole.rows.items()
    assert found.times.items() <= whole.times.items()
    assert found.times.keys() >= found.rows.keys()
    assert found.first_reached() == whole.first_reached()
    assert trajectory.median(trajectory.iteration_times({"r0": found})) == pytest.approx(0.1)
    with pytest.raises(RecordingError, match="iteration 4990 stands there twice"):
        trajectory.read(write(tmp_path, *rows, (4990, 600.0, {"value": 0.5}, {})), whole=False)
