"""The thesis' CSV layouts: in and out to the byte, and what their lines say."""

import os
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laptop.cli import main
from sim.virtual.run import run_virtually
from swarm.errors import RecordingError
from swarm.recording import thesis_csv
from swarm.recording.run import Run
from swarm.recording.thesis_ranges import read_folder

DATA = Path(os.environ.get("SWARM_THESIS_DATA") or Path(__file__).parents[3].parent / "shared/thesis-data")

CONSENSUS = "100.5,0.5,0\r\n100.6,0.5,1\r\n101.5,1.75,0\r\n101.6,1.75,1\r\n"
LOCALIZATION = (
    "100.5,0.0,0.0,0.0,0.0,0.0,0.0\n"
    "100.6,0.0,0.0,0.0,0.0,0.0,0.0,1\n"
    "101.5,0.0,100.0,0.0,0.0,-3.7,-13.0,0,45.1,62.4,43.9,152.6\n"
    "101.6,0.0,100.0,0.0,0.0,-3.7,-13.0,1,45.1,62.4,43.9,152.6\n"
)


def swarm(*arguments):
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return ended.value.code


def round_trip(source, tmp_path):
    run, back = tmp_path / "run", tmp_path / "back"
    assert swarm("import", source, "-o", run) == 0
    assert swarm("export", run, "--csv", back) == 0
    return Run(run), {path.relative_to(back): path.read_bytes() for path in back.rglob("*.csv")}


def files(source):
    return {path.relative_to(source): path.read_bytes() for path in source.rglob("*.csv")}


def write(folder, name, text):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text.encode())


def test_states_go_in_and_out(tmp_path):
    source = tmp_path / "consensus"
    write(source, "0.csv", CONSENSUS)
    write(source, "1.csv", "")
    run, back = round_trip(source, tmp_path)
    assert back == files(source)
    path = run.trajectories()["r0"]
    assert path.rows == {0: ("0.5",), 1: ("1.75",)}
    assert path.times == pytest.approx({0: 0.0, 1: 1.0})
    assert run.epoch + run.origin == pytest.approx(100.5)


def test_leds_have_two_channels(tmp_path):
    source = tmp_path / "led_sync"
    write(source, "frequency/0.csv", CONSENSUS)
    write(source, "phase/0.csv", "100.5,0.25\n101.0,0.5\n")
    run, back = round_trip(source, tmp_path)
    assert back == files(source)
    assert run.states()["phase"] == {"r0": "swarm/r0/app/led_sync/phase/state"}
    assert run.trajectories(channel="phase")["r0"].rows == {0: ("0.25",), 1: ("0.5",)}


def test_localization_has_measurements_in_metres(tmp_path):
    source = tmp_path / "localization"
    write(source, "0.csv", LOCALIZATION)
    run, back = round_trip(source, tmp_path)
    assert back == files(source)
    assert run.trajectories()["r0"].value(1, "result.y") == 1.0
    (measured,) = run.samples("**/measurement")
    assert measured.message["k"] == 0
    assert measured.message["distance"] == pytest.approx(0.624)


def test_truth_values_round_trips_and_places_are_told_apart(tmp_path):
    source = tmp_path / "all"
    write(source, "standup/0.csv", "1.5,False\n2.5,True\n")
    write(source, "latency/RTT50.csv", "0.05\n0.06\n")
    write(source, "calibration/full.csv", "0\n268.0,228.0,1083.0\n1\n")
    run, back = round_trip(source, tmp_path)
    assert back == files(source)
    assert run.trajectories("standup", "standup")["r0"].rows == {0: ("False",), 1: ("True",)}
    assert run.trajectories("latency", "RTT50")["r0"].rows == {0: ("0.05",), 1: ("0.06",)}


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("consensus/0.csv", "1.5,0.5\n2.5,what\n", r"0\.csv:2: 'what' is no number"),
        ("consensus/0.csv", "1.5\n", r"0\.csv:1: 1 columns are none of consensus"),
        ("localization/0.csv", "1,2,3\n", r"0\.csv:1: 3 columns are none of localization"),
        ("latency/RTT50.csv", "1,2\n", r"RTT50\.csv:1: 2 columns are none of latency"),
    ],
)
def test_what_is_none_of_the_layouts_is_named(tmp_path, capsys, name, text, words):
    write(tmp_path / "in", name, text)
    assert swarm("import", tmp_path / "in", "-o", tmp_path / "out") == 2
    told = capsys.readouterr().err
    assert re.search(words, told)
    assert str(tmp_path / "in" / name) in told
    assert not list((tmp_path / "out").iterdir()), "the next attempt finds nothing of this one"


@given(st.text(max_size=60), st.sampled_from(thesis_csv.FOLDERS))
def test_any_text_is_read_or_refused(text, kind):
    try:
        lines = [raw for raw, _ in thesis_csv.read(text, kind, "x.csv")]
    except RecordingError:
        return
    assert "".join(lines) == text


def test_a_run_of_ours_goes_out_and_can_be_replayed(tmp_path):
    """What a simulated swarm estimated and measured, as the thesis would have written it: our own replay takes it."""
    run_virtually("localization", "--robots", "3", "--iterations", "20", "--record", str(tmp_path / "run"))
    assert swarm("export", tmp_path / "run", "--csv", tmp_path / "csv", "--table", tmp_path / "table") == 0
    recordings = read_folder(tmp_path / "csv")
    run = Run(tmp_path / "run")
    for name, recording in zip(run.robots, recordings, strict=True):
        path = run.trajectories()[name]
        assert recording.steps == 20
        assert recording.estimates[20] == pytest.approx((path.value(20, "result.x"), path.value(20, "result.y")))
    header, first = (tmp_path / "table" / "r0.localization.csv").read_text().splitlines()[:2]
    assert header.startswith("k,t,q[0],q[1]")
    assert first.startswith("0,0.")


def test_lines_whose_times_step_back_keep_their_order(tmp_path):
    source = tmp_path / "consensus"
    write(source, "0.csv", "2.5,0.5,0\n2.6,0.5,1\n1.0,0.75,0\n3.0,0.75,1\n")
    _, back = round_trip(source, tmp_path)
    assert back == files(source)


def test_two_files_that_share_a_topic_are_refused(tmp_path, capsys):
    write(tmp_path / "in" / "latency", "a/b.csv", "1,2\n")
    write(tmp_path / "in" / "latency", "a.b.csv", "1,2\n")
    assert swarm("import", tmp_path / "in", "-o", tmp_path / "out") == 2
    assert "a dot for a slash" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_robots_that_drive_to_their_places_go_out_with_all_their_states(tmp_path):
    run_virtually("formation", "--robots", "3", "--iterations", "8", "--record", str(tmp_path / "run"))
    assert swarm("export", tmp_path / "run", "--csv", tmp_path / "csv") == 0
    known = Run(tmp_path / "run").trajectories()["r0"].rows
    assert (tmp_path / "csv" / "0.csv").read_text().count(",0\n") == len(known) - 1


def test_an_estimate_goes_out_with_the_measurement_of_its_own_step():
    rows = [(k, float(k), 0.0, 0.0) for k in (0, 1, 2, 50, 51)]
    text = thesis_csv.localization(rows, {1: (0.1, 0.0, 0.0), 3: (0.3, 0.0, 0.0), 51: (0.5, 0.0, 0.0)})
    assert [(line.split(",")[0], float(line.split(",")[9])) for line in text.splitlines() if line.count(",") == 11] == [
        ("1.0", 10.0),
        ("1.0", 10.0),
        ("51.0", 50.0),
        ("51.0", 50.0),
    ]


def test_states_of_ours_go_out_as_new_and_sent(tmp_path):
    run_virtually("consensus", "--robots", "2", "--iterations", "2", "--record", str(tmp_path / "run"))
    assert swarm("export", tmp_path / "run", "--csv", tmp_path / "consensus") == 0
    lines = (tmp_path / "consensus" / "1.csv").read_text().splitlines()
    assert [line.count(",") for line in lines] == [1, 2, 2, 2, 2]
    assert [line[-1] for line in lines[1:]] == ["0", "1", "0", "1"]
    assert Run(tmp_path / "run").trajectories()["r1"].rows[2][0] == lines[3].split(",")[1]
    assert swarm("export", tmp_path / "run", "--csv", tmp_path / "consensus") == 2  # nothing is written over


def test_one_file_for_all_robots(tmp_path):
    run_virtually("consensus", "--robots", "2", "--iterations", "5", "--record", str(tmp_path / "run"))
    assert swarm("export", tmp_path / "run", "--mcap", tmp_path / "all.mcap") == 0
    before, after = Run(tmp_path / "run"), Run(tmp_path / "all.mcap")
    said = [(sample.topic, sample.data) for sample in after.samples()]
    added = {"/scene", "/tf", "/log"}
    assert [each for each in said if each[0] not in added] == [(s.topic, s.data) for s in before.samples()]
    assert added <= {topic for topic, _ in said}
    assert after.trajectories()["r1"].rows == before.trajectories()["r1"].rows
    assert after.damage == []


@pytest.mark.parametrize(
    "folder",
    [
        *("async", "calibration", "consensus", "flooding", "latency", "led_sync", "standup", "unicast"),
        pytest.param("localization", marks=pytest.mark.slow),
    ],
)
def test_all_of_the_thesis_data_goes_in_and_out_to_the_byte(folder, tmp_path):
    source = DATA / folder
    if not source.is_dir():
        pytest.skip(f"{source}: no thesis recordings here (SWARM_THESIS_DATA names their folder)")
    _, back = round_trip(source, tmp_path)
    assert back == files(source)
