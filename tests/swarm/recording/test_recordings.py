import os
import struct
from pathlib import Path

import pytest

from swarm.errors import RecordingError
from swarm.recording.thesis_ranges import cost, read_folder, read_recording

DATA = Path(os.environ.get("SWARM_THESIS_DATA") or Path(__file__).parents[3].parent / "shared/thesis-data")
START = "100.5,0.0,0.0,0.0,0.0,0.0,0.0"
GOOD = f"""\
{START}
100.6,0.0,0.0,0.0,0.0,0.0,0.0,1
101.5,0.0,1.0,0.0,0.0,-3.7,-13.0,0,{cost(62.4, 0.0, 1.0, 43.9, 152.6)},62.4,43.9,152.6
101.6,0.0,1.0,0.0,0.0,-3.7,-13.0,1,{cost(62.4, 0.0, 1.0, 43.9, 152.6)},62.4,43.9,152.6
102.5,14.97,52.06,1.2,22.9,-8.1,-28.3,0,{cost(62.5, 14.97, 52.06, 44.0, 152.7)},62.5,44.0,152.7
"""


def line(*values):
    return ",".join(map(str, values)) + "\n"


def test_reads_rows_times_and_states(tmp_path):
    (tmp_path / "0.csv").write_text(GOOD)
    recording = read_recording(tmp_path, 0)
    assert recording.rows == ((0.624, 0.439, 1.526), (0.625, 0.44, 1.527))
    assert recording.estimates == ((0.0, 0.0), (0.0, 0.01), (14.97 / 100, 52.06 / 100))
    assert recording.times == (1.0, 2.0)
    assert recording.steps == 2
    assert read_folder(tmp_path) == [recording]


@pytest.mark.parametrize(
    ("text", "number", "words"),
    [
        ("", 1, "ends before the first measurement"),
        (START + "\n", 2, "ends before the first measurement"),
        ("1,2,3\n", 1, "3 columns, the first line has 7"),
        (GOOD + "103.5,15.0,52.1", 6, "3 columns, expected 12"),
        (GOOD + "\n", 6, "column 1 is '', expected a number"),
        (
            GOOD + line(103, 0, 0, 0, 0, 0, 0, 0, 1, 62, 43, "oops"),
            6,
            "column 12 is 'oops', expected a number",
        ),
        (
            GOOD + line(103, 0, 0, 0, 0, 0, 0, 0, 1, "nan", 43, 152),
            6,
            "column 10 is 'nan', expected a number",
        ),
        (
            GOOD + line(103, 0, 0, 0, 0, 0, 0, 0, 1, "inf", 43, 152),
            6,
            "column 10 is 'inf', expected a number",
        ),
        (
            GOOD + line(103, 0, 0, 0, 0, 0, 0, 0, 1, "6_2", 43, 152),
            6,
            "column 10 is '6_2', expected a number",
        ),
        (GOOD + line(103, 0, 0, 0, 0, 0, 0, 2, 1, 62, 43, 152), 6, "column 8 is 2, expected the flag 0 or 1"),
        (GOOD + line(103, 0, 0, 0, 0, 0, 0, 0), 6, "a new state without cost, distance and own place"),
        (GOOD + line(103, 0, 0, 0, 0, 0, 0, 0, 1, -62, 43, 152), 6, "a distance of -62 cm"),
        (GOOD + line(103, 0, 0, 0, 0, 0, 0, 0, 1, 62, 43), 6, "11 columns"),
        (GOOD + "\x00\xff\n", 6, "column 1 is"),
        (GOOD + line(103, 0, 0, 0, "1e300", 0, 0, 0, 1, 62, 43, 152), 6, "column 5 is 1e+300, no number here is above"),
        (GOOD + line(103, 0, 0, 0, 0, 0, 0, 0, 45, 0.62, 43, 152), 6, "the line's lengths give 6.2"),
        (GOOD + line(103, 0, 0, 0, 0, 0, 0, 0, -45, 62, 43, 152), 6, "a cost of -45 in column 9"),
    ],
)
def test_what_is_wrong_is_named_with_file_and_line(tmp_path, text, number, words):
    path = tmp_path / "0.csv"
    path.write_text(text, "latin-1")
    with pytest.raises(RecordingError) as error:
        read_recording(tmp_path, 0)
    assert str(error.value).startswith(f"{path}:{number}: ")
    assert words in str(error.value)


def test_what_is_not_there_is_named(tmp_path):
    with pytest.raises(RecordingError, match=r"nowhere: there is no such folder"):
        read_recording(tmp_path / "nowhere", 0)
    with pytest.raises(RecordingError, match=r"there is no such folder"):
        read_folder(tmp_path / "nowhere")
    (tmp_path / "0.csv").write_text(GOOD)
    with pytest.raises(RecordingError, match=r"1\.csv: missing; a recording holds a file"):
        read_recording(tmp_path, 1)
    (tmp_path / "1.csv").mkdir()
    with pytest.raises(RecordingError, match=r"1\.csv: cannot be read"):
        read_folder(tmp_path)


def float32(value):
    return struct.unpack("f", struct.pack("f", value))[0]


@pytest.mark.skipif(not DATA.is_dir(), reason=f"the thesis' recordings are not at {DATA} (SWARM_THESIS_DATA)")
@pytest.mark.parametrize(
    ("folder", "gamma", "steps", "of_each"),
    [
        ("test_2", 4e-6, 541, [542, 542, 541]),
        ("test_3", 4e-6, 673, [673, 674, 674]),
        ("test_5", 5e-7, 2009, [2010, 2010, 2009]),
    ],
)
def test_measurement_k_takes_state_k_to_state_k_plus_1(folder, gamma, steps, of_each):
    """The thesis' equations 4.4 to 4.6 on the rows as we number them give the recorded trajectory."""
    recordings = read_folder(DATA / "localization" / folder)
    assert [recording.steps for recording in recordings] == of_each
    assert min(of_each) == steps
    weights = [{0: 1 / 2, 1: 1 / 2}, {0: 1 / 3, 1: 1 / 3, 2: 1 / 3}, {1: 1 / 2, 2: 1 / 2}]
    states = [(0j, 0j, 0j)] * 3  # x, z, g as complex numbers, cm
    worst = 0.0
    for k in range(steps):
        sent = [tuple(complex(float32(v.real), float32(v.imag)) for v in state) for state in states]
        new = []
        for i, (x, z, g) in enumerate(states):
            around = [(w, states[i] if j == i else sent[j]) for j, w in weights[i].items()]
            distance, own_x, own_y = (100 * value for value in recordings[i].rows[k])
            x = sum(w * other[0] for w, other in around) - z - gamma * g
            z = sum(w * (other[1] + gamma * other[2]) for w, other in around) - gamma * g
            away = complex(own_x, own_y) - x
            new.append((x, z, 4 * (distance**2 - abs(away) ** 2) * away))
        states = new
        for recording, (x, _, _) in zip(recordings, states, strict=True):
            worst = max(worst, abs(x - 100 * complex(*recording.estimates[k + 1])))
    assert worst < 1e-9  # cm
