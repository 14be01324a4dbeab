"""A whole run read as one: several files, clocks and apps; what two apps of a robot have both recorded comes once."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.errors import RecordingError
from swarm.messages import AppState, Clock, Pose
from swarm.recording.axis import Clocks, Relation
from swarm.recording.core.writer import Writer
from swarm.recording.run import Run, natural
from swarm.recording.virtual_file import DirectRecording


def write(path, robot, clock, epoch_s, *messages):
    epoch_ns = round(epoch_s * 1e9)
    writer = Writer("test", epoch_ns=epoch_ns)
    run = {"app": "x", "run": "1f", "robot": robot, "epoch_ns": str(epoch_ns), "clock": clock}
    writer.metadata("run", run)
    for topic, t, message in messages:
        writer.write(f"swarm/{robot}/{topic}", t, message)
    path.write_bytes(b"".join(writer.finish()))


def state(k, t, value=0.5):
    return "app/x/state", t, AppState(t, k, {"v": value}, {})


def clock(t, offset, root="r0", rate=0.0):
    return "mesh/clock", t, Clock(t, offset, rate, root, 0, 0.001)


def test_one_machine_has_one_clock(tmp_path):
    write(tmp_path / "r0.x.mcap", "r0", "boot", 5.0, state(0, 100.0), state(1, 101.0))
    write(tmp_path / "r1.x.mcap", "r1", "boot", 5.1, clock(99.0, 7.0), state(0, 100.5))
    run = Run(tmp_path)
    assert run.origin == 100.0
    assert [(s.topic, round(s.t, 6)) for s in run.samples("**/state")] == [
        ("swarm/r0/app/x/state", 0.0),
        ("swarm/r1/app/x/state", 0.5),
        ("swarm/r0/app/x/state", 1.0),
    ]
    assert run.robots == ("r0", "r1")
    assert run.apps == ("x",)
    assert run.info["run"] == "1f"
    assert run.damage == []


def test_robots_are_brought_together_by_the_mesh_clock(tmp_path):
    """r1's clock is 1000 s behind and 100 ppm slow; its time of day is an hour wrong."""
    write(tmp_path / "r0.x.mcap", "r0", "a", 0.0, clock(1000.0, 0.0), state(0, 1010.0))
    slow = [clock(1.0 + i, 1000.0 + 1e-4 * i, rate=1e-4) for i in range(20)]
    write(tmp_path / "r1.x.mcap", "r1", "b", 3600.0, *slow, state(0, 11.0), state(1, 51.0))
    run = Run(tmp_path)
    times = run.trajectories()["r1"].times
    assert times[0] == pytest.approx(1.0 + 1e-4 * 10, abs=1e-9)
    assert times[1] == pytest.approx(41.0 + 1e-4 * 50, abs=1e-9)
    assert run.damage == []


def test_the_worlds_time_of_a_simulation_counts_more_than_the_mesh_clock(tmp_path):
    for name, offset in (("r0", "-1000.0"), ("r1", "-10.0")):
        file = DirectRecording(tmp_path / f"{name}.x.mcap", {"app": "x"}, name)
        file.metadata("world_clock", {"offset": offset, "rate": "1e-4"})
        topic, t, sample = clock(5.0, 3.0)
        file.write(f"swarm/{name}/{topic}", t, sample)
        file.write(f"swarm/{name}/app/x/state", 2000.0, AppState(2000.0, 0, {"v": 0.5}, {}))
        file.close()
    run = Run(tmp_path)
    assert run.basis == "the simulated world"
    assert {name: path.times[0] for name, path in run.trajectories().items()} == pytest.approx({"r0": 0.0, "r1": 990.0})
    assert run.origin == pytest.approx(1000.2)


def test_a_relation_to_the_worlds_time_that_is_none_is_named(tmp_path):
    file = DirectRecording(tmp_path / "r0.x.mcap", {"app": "x"}, "r0")
    file.metadata("world_clock", {"offset": "soon"})
    file.close()
    assert "expected numbers `offset` and `rate`, got {'offset': 'soon'}" in Run(tmp_path).damage[0]


def test_a_robot_without_mesh_clock_goes_by_its_time_of_day_and_is_named(tmp_path):
    write(tmp_path / "r0.x.mcap", "r0", "a", 50.0, clock(1.0, 0.0), state(0, 10.0))
    write(tmp_path / "r1.x.mcap", "r1", "b", 20.0, state(0, 41.0))
    run = Run(tmp_path)
    assert run.trajectories()["r1"].times[0] == pytest.approx(1.0)
    assert run.epoch == pytest.approx(50.0)
    assert run.damage == ["clock b: no samples of the mesh clock, its time of day has to do"]


@given(st.lists(st.tuples(st.floats(0, 1000), st.floats(-10, 10)), min_size=1, max_size=8, unique_by=lambda it: it[0]))
def test_common_time_meets_every_sample_of_the_mesh_clock(samples):
    clocks = Clocks()
    clocks.add("a", 0.0)
    clocks.add("b", 0.0)
    for t, offset in samples:
        clocks.relate("b", Relation(t, offset, 0.0, "r0"))
    axis = clocks.axes()["b"]
    for t, offset in samples:
        assert axis(t) == pytest.approx(t + offset)


def test_what_two_apps_of_a_robot_recorded_comes_once_and_in_order(tmp_path):
    poses = [("dwm/pose", 1.0 + 0.1 * i, Pose(1.0 + 0.1 * i, i, 0.0, 0.0, None, 90, "ekf")) for i in range(10)]
    late = [poses[i] for i in (1, 0, 3, 2, 5, 4, 7, 6, 9, 8)]
    write(tmp_path / "r0.a.mcap", "r0", "boot", 0.0, *late)
    write(tmp_path / "r0.b.mcap", "r0", "boot", 0.0, *poses[4:])
    found = [sample.message["sequence"] for sample in Run(tmp_path).samples()]
    assert found == list(range(10))


def test_what_one_app_recorded_twice_comes_twice(tmp_path):
    """Two copies of a message that a robot hands on in one moment."""
    pose = ("dwm/pose", 1.0, Pose(1.0, 7, 0.0, 0.0, None, 90, "ekf"))
    write(tmp_path / "r0.a.mcap", "r0", "boot", 0.0, pose, pose)
    write(tmp_path / "r0.b.mcap", "r0", "boot", 0.0, pose)
    assert [sample.message["sequence"] for sample in Run(tmp_path).samples()] == [7, 7]


def test_the_app_that_is_looked_at_is_that_of_the_run_or_the_one_asked_for(tmp_path):
    (tmp_path / "run.toml").write_text('app = "x"\n')
    write(tmp_path / "r0.a.mcap", "r0", "boot", 0.0, ("app/a/state", 1.0, AppState(1.0, 3, {"v": 1.0}, {})))
    write(tmp_path / "r0.x.mcap", "r0", "boot", 0.0, state(0, 1.0))
    assert Run(tmp_path).app == "x"
    assert list(Run(tmp_path).trajectories()["r0"].rows) == [0]
    assert list(Run(tmp_path, "a").trajectories()["r0"].rows) == [3]
    with pytest.raises(RecordingError, match="no app b is recorded; there are: a, x"):
        Run(tmp_path, "b")


def test_a_single_file_is_a_run_too_and_none_is_an_error(tmp_path):
    with pytest.raises(RecordingError, match="there is no recording"):
        Run(tmp_path)
    write(tmp_path / "r0.x.mcap", "r0", "boot", 0.0, state(0, 1.0))
    assert Run(tmp_path / "r0.x.mcap").trajectories()["r0"].last == 0
    whole = (tmp_path / "r0.x.mcap").read_bytes()
    (tmp_path / "r0.x.mcap").write_bytes(whole[:-20])
    assert "cut off" in Run(tmp_path).damage[0]


def test_of_an_app_that_began_anew_the_later_states_count(tmp_path):
    write(
        tmp_path / "r0.x.mcap", "r0", "boot", 0.0, state(0, 1.0), state(1, 2.0, 1.0), state(0, 3.0), state(1, 4.0, 2.0)
    )
    run = Run(tmp_path)
    assert run.trajectories()["r0"].rows == {0: ("0.5",), 1: ("2.0",)}
    assert run.trajectories()["r0"].times[1] == 3.0
    assert run.damage == ["r0: 1 iterations stand there twice and differ (it began anew)"]


def test_channels_are_told_apart(tmp_path):
    inner = "app/x/frequency/state", 1.0, AppState(1.0, 0, {"f": 2.0}, {})
    write(tmp_path / "r0.x.mcap", "r0", "boot", 0.0, state(0, 1.0), inner)
    run = Run(tmp_path)
    assert run.states() == {
        "": {"r0": "swarm/r0/app/x/state"},
        "frequency": {"r0": "swarm/r0/app/x/frequency/state"},
    }
    assert run.trajectories(channel="frequency")["r0"].columns == ("f",)


def test_ten_comes_after_nine():
    assert sorted(["r10", "r9", "r1", "base"], key=natural) == ["base", "r1", "r9", "r10"]


@pytest.mark.parametrize(
    ("key", "names"),
    [
        ("swarm/*/app/x/state", "ab"),
        ("swarm/r0/**", "acd"),
        ("**/state", "abd"),
        ("**", "abcd"),
        ("swarm/r0/app/*/state", "a"),
        ("swarm/*/app/**/state", "abd"),
        ("swarm/r0/app/x/st*", "a"),
        ("swarm/r.", ""),
    ],
)
def test_topics_are_chosen_as_on_the_bus(tmp_path, key, names):
    keys = {"a": "swarm/r0/app/x/state", "b": "swarm/r1/app/x/state", "c": "swarm/r0/dwm/pose",
            "d": "swarm/r0/app/x/record/state"}  # fmt: skip
    writer = Writer("test", epoch_ns=0)
    for topic in keys.values():
        writer.write(topic, 1.0, {"t": 1.0})
    (tmp_path / "x.mcap").write_bytes(b"".join(writer.finish()))
    found = {sample.topic for sample in Run(tmp_path / "x.mcap").samples(key)}
    assert found == {keys[name] for name in names}
