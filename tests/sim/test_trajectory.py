import pytest

from services.sim import trajectory
from swarm.errors import RecordingError

HEADER = "k,t,value,result.value\n"


def write(tmp_path, text):
    path = tmp_path / "r0.consensus.csv"
    path.write_text(text)
    return path


def test_reads_what_a_host_writes(tmp_path):
    found = trajectory.read(write(tmp_path, HEADER + "0,10.0,0.5,0.5\n1,10.03,1.25,1.25\n"))
    assert found.last == 1
    assert found.value(1, "value") == 1.25
    assert found.first_reached() == 10.03


def test_an_unfinished_last_line_is_left_out(tmp_path):
    assert trajectory.read(write(tmp_path, HEADER + "0,10.0,0.5,0.5\n1,10.0")).last == 0


def test_a_repeated_iteration_must_be_equal(tmp_path):
    again = trajectory.read(write(tmp_path, HEADER + "3,10.0,0.5,0.5\n3,11.0,0.5,0.5\n"))
    assert again.times[3] == 10.0
    with pytest.raises(RecordingError, match=r":3: iteration 3 stands there twice"):
        trajectory.read(write(tmp_path, HEADER + "3,10.0,0.5,0.5\n3,11.0,0.50000001,0.5\n"))


@pytest.mark.parametrize(
    ("text", "words"),
    [("a,b\n", ":1: expected the columns"), (HEADER + "0,1\n", ":2: 2 cells"), (HEADER + "x,1,2,3\n", ":2: k and t")],
)
def test_damage_is_named_with_file_and_line(tmp_path, text, words):
    with pytest.raises(RecordingError, match=words):
        trajectory.read(write(tmp_path, text))


def test_nothing_recorded_is_empty(tmp_path):
    assert trajectory.read(tmp_path / "absent.csv").last == -1
    assert trajectory.read(write(tmp_path, "")).last == -1


def test_iterations_are_measured_over_windows_because_lockstep_alternates():
    # 2 ms and 64 ms in turn: a median of single intervals would say 2 or 64, the rate is 33 ms.
    times, t = {}, 0.0
    for k in range(60):
        times[k] = t
        t += 0.002 if k % 2 else 0.064
    values = trajectory.iteration_times({"r0": trajectory.Trajectory((), times, {})})
    assert trajectory.median(values) == pytest.approx(0.033)
    assert trajectory.percentile(values, 95) == pytest.approx(0.033)


def test_percentiles_are_nearest_rank():
    assert trajectory.percentile([], 95) is None
    assert trajectory.percentile([1.0], 95) == 1.0
    assert trajectory.percentile(list(map(float, range(1, 101))), 95) == 95.0
