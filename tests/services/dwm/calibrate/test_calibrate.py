"""`swarm calibrate` from end to end: a person of a script, real processes, a simulated module."""

import itertools
import math
import os
import re
import threading
from queue import SimpleQueue
from types import SimpleNamespace

import pytest
from conftest import CONFIG
from dwm_rig import ANCHORS, working
from thesis_data import DATA, needs_calibration, needs_localization

from services.dwm.calibrate.session import Hearing, hold
from services.dwm.core.calibration import calibration_file
from services.dwm.core.calibration.guide import QUARTERS, Guide
from services.dwm.core.calibration.samples import HEADER, RangeSample, read, write
from swarm import config as configuration
from swarm.bus.zenoh_bus import Bus
from swarm.errors import BusError
from swarm.messages import Buttons, Pose, Range, Ranges

SWARM = (
    ANCHORS
    + """[dwm]
source = "serial:{directory}/{{robot}}/dwm.tty"
target = "C933"
calibration = "of/{{robot}}.toml"
[simulation]
target = [0.5, 1.0]
[simulation.places]
r0 = [0.5, 1.5, 0.0]
"""
)
PROMPT = re.compile(r"place \d+ of \d+: \((\S+), (\S+)\) m, heading (\d+) degrees: start\?")
PLACES = "0.6,0.9 1.0,0.5 1.5,1.5 0.3,0.3 1.7,0.4 0.5,1.6"


@pytest.fixture
def swarm(processes, runtime):
    """swarm.toml, and a calibration that does nothing, so that the service starts."""
    processes.config.write_text(CONFIG + SWARM.format(directory=runtime))
    return configuration.load(processes.config)


@pytest.fixture
def board(swarm, runtime):
    with working(runtime, swarm, "r0") as board:
        yield board


def calibrate(processes, *arguments):
    return processes.start("-m", "services.dwm.calibrate", *arguments, "--robots", "r0")


class Person:
    """Presses button A twice a second while something is asked of them: a press before the session hears is lost."""

    def __init__(self, runtime):
        self.want, self._over = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._press, args=(runtime,))
        self._thread.start()

    def _press(self, runtime):
        pressed = 0
        with Bus.of(runtime) as bus:
            while not self._over.wait(0.5):
                pressed += self.want.is_set()
                bus.publish("swarm/r0/balancer/buttons", Buttons(1.0, False, False, False, pressed, 0, 0))

    def told(self, line):
        if "measuring" in line:
            self.want.clear()

    def go(self):
        self._over.set()
        self._thread.join()


def lead(process, board, answer, off=(0.0, 0.0), told=lambda _: None):
    """Put the module where it is asked for (and a bit off), then answer. Gives all that was said."""
    said = []
    for line in process.stdout:
        said.append(line)
        told(line)
        found = PROMPT.match(line)
        if found:
            x, y, degrees = map(float, found.groups())
            board.update_pose("r0", x + off[0], y + off[1], math.radians(degrees))
            answer()
    return "".join(said)


@pytest.mark.slow
def test_a_session_makes_a_file_that_the_service_takes_and_a_check_confirms(processes, router, swarm, board, runtime):
    text = processes.config.read_text()
    processes.config.write_text(text.replace("calibration =", "# calibration ="))
    service = processes.start_ready("-m", "services.dwm")
    processes.config.write_text(text)
    session = calibrate(
        processes, "position", "--places", PLACES, "--orientations", "2", "--count", "6", "--target", "0.5", "1.0",
        "--samples", str(runtime / "s.csv"), "--no-plot",
    )  # fmt: skip

    def press():
        session.stdin.write("start\n")
        session.stdin.flush()

    said = lead(session, board, press)
    assert session.wait(60) == 0, session.stderr.read()
    assert "places: " in said
    assert "<- taken" in said
    assert re.search(r"5/6  C933 [\d.]+ m \+- [\d.]+ cm", said)
    found = read((runtime / "s.csv").read_text(), "s.csv")
    assert {sample.place for sample in found} == set(range(6))
    assert {sample.module for sample in found} == {"D001", "D002", "D003", "C933"}

    fitted = calibrate(processes, "fit", str(runtime / "s.csv"), "--target", "0.5", "1.0", "--no-plot")
    assert fitted.wait(60) == 0, fitted.stderr.read()
    file = calibration_file.parse((runtime / "of" / "r0.toml").read_text(), "f")
    assert file.distance[1].places == file.position[1].places == 6
    assert file.distance[1].nested < 0.8 * file.distance[1].left_out["raw"]
    assert file.distance[1].sha256 == file.position[1].sha256

    service.terminate()
    service.wait(60)
    processes.start_ready("-m", "services.dwm")
    arguments = ("check", "--places", "0.7,0.7 1.2,1.2 1.4,0.5", "--orientations", "1", "--count", "8",
                 "--target", "0.5", "1.0")  # fmt: skip
    for off, code in (((0.0, 0.0), 0), ((0.3, 0.2), 1)):
        session = calibrate(processes, *arguments, "--samples", str(runtime / f"check{code}.csv"))
        said = lead(session, board, press, off)
        assert session.wait(60) == code, said
        assert "ranges: rms error" in said
        assert "places: rms error" in said
        assert ("calibrate anew" in said) == bool(code), said


def test_buttons_of_the_robot_lead_as_well(processes, router, swarm, board, runtime):
    processes.config.write_text(processes.config.read_text().replace("calibration =", "# calibration ="))
    processes.start_ready("-m", "services.dwm")
    session = calibrate(
        processes, "distance", "--places", "0.6,0.9 1.0,0.5 1.5,1.5", "--orientations", "1", "--count", "2",
        "--samples", str(runtime / "s.csv"), "--no-plot", "--output", str(runtime / "out.toml"),
    )  # fmt: skip
    person = Person(runtime)
    try:
        said = lead(session, board, person.want.set, told=person.told)
    finally:
        person.go()
    assert session.wait(60) == 0, session.stderr.read()
    assert "ranges: " in said
    assert 'put  calibration = "calibration/{robot}.toml"  into [dwm]' in said
    assert calibration_file.parse((runtime / "out.toml").read_text(), "f").position is None


def test_a_silent_module_is_named(router, runtime, monkeypatch):
    """To this session a second passes whenever it looks at the clock."""
    answers, person = os.pipe()
    os.write(person, b"start\n")
    os.close(person)
    seconds = itertools.count()
    with os.fdopen(answers) as stdin, Bus.of(runtime) as bus:
        monkeypatch.setattr("sys.stdin", stdin)
        guide, said = Guide([(1.0, 1.0)], QUARTERS[:1], 1), []
        with pytest.raises(BusError, match=r"does its dwm service run\?"):
            hold(guide, Hearing(bus, "r0"), "C933", runtime / "s.csv", said.append, lambda: float(next(seconds)))
    assert guide.measuring
    assert said[-1].endswith("measuring")


def test_samples_that_are_to_be_measured_anew_are_in_no_file_of_a_session_that_fails(tmp_path, monkeypatch):
    """The robot has been moved by then: they would be fitted to another place."""
    answers, person = os.pipe()
    os.write(person, b"start\nredo\nstart\n")
    os.close(person)
    heard, seconds, path = SimpleQueue(), itertools.count(step=0.5), tmp_path / "s.csv"
    for n in range(3):  # two of them while the robot settles
        heard.put(Ranges(float(n), n, (Range("D001", 1.0 + n, 1.0 + n, 100, 0.0, n),)))
        heard.put(Pose(float(n), n, 1.0, 1.0, None, 90, "module"))
    kept = []

    def say(text):
        kept.append(path.read_text().splitlines()[1:])

    with os.fdopen(answers) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        guide = Guide([(1.0, 1.0)], QUARTERS[:2], 1)
        with pytest.raises(BusError):
            hold(guide, SimpleNamespace(messages=heard), "D001", path, say, lambda: next(seconds))
    assert max(map(len, kept)) == 1, "what is measured is written at once"
    assert path.read_text() == HEADER + "\n"


def test_the_end_of_the_answers_ends_the_session(processes, router, swarm, runtime):
    session = calibrate(processes, "distance", "--samples", str(runtime / "s.csv"))
    _, error = session.communicate("", timeout=240)
    assert session.returncode == 2
    assert "nothing was measured" in error


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fit", "nowhere.csv"], "nowhere.csv: cannot be read"),
        (["fit", "empty."], "holds no *.csv"),
        (["distance", "--places", "1;2"], '--places: expected "x,y x,y'),
        (["fit", "line.csv"], "all places lie within 0 cm of one line, 0 degrees from x: across it nothing is known"),
        (["check"], "of/r0.toml: ranges and places are corrected as [dwm] says only; make one by"),
        (["offset", "nowhere.json"], "nowhere.json: there is no such report of swarm commission, and no such folder"),
    ],
)
def test_what_is_wrong_is_one_line(processes, swarm, runtime, arguments, words):
    (runtime / "empty.").mkdir()
    rows = [RangeSample(k, 0.3 * k, 0.5, None, 0.0, "FFFF", 1.0, 0.3 * k, 0.52) for k in range(5)]
    (runtime / "line.csv").write_text("\n".join([HEADER, *map(write, rows)]))
    path = [str(runtime / word) if word.endswith((".csv", ".")) else word for word in arguments]
    process = calibrate(processes, *path)
    _, error = process.communicate(timeout=240)
    assert process.returncode == 2
    assert words in error
    assert error.count("\n") == 1
    assert not (runtime / "of").exists()


@needs_calibration
def test_the_thesis_samples_give_a_file_and_its_picture(processes, swarm, runtime):
    process = calibrate(processes, "fit", str(DATA / "calibration"), "--places", "thesis", "--target", "0.5", "1.0")
    said, error = process.communicate(timeout=240)
    assert process.returncode == 0, error
    assert re.search(r"curved +2\.72 cm  <- taken", said)
    assert re.search(r"scaled +5\.08 cm  <- taken", said)
    assert (runtime / "of" / "r0.png").read_bytes().startswith(b"\x89PNG")
    process = calibrate(processes, "fit", str(DATA / "calibration"), "--thesis")
    said, _ = process.communicate(timeout=240)
    assert "eq. 2.4   m = 1.056 d + 6.299 cm" in said


@needs_localization
def test_an_offset_is_learned_and_added_to_the_file(processes, swarm, runtime):
    rows = [
        RangeSample(k, 0.5 * k, 0.5, None, 0.1 * i, "C933", math.dist((0.5 * k, 0.5), (0.5, 1.0)), None, None)
        for k in range(4)
        for i in range(3)
    ]
    (runtime / "s.csv").write_text("\n".join([HEADER, *map(write, rows)]))
    fit = calibrate(processes, "fit", str(runtime / "s.csv"), "--target", "0.5", "1.0", "--no-plot")
    assert fit.wait(60) == 0, fit.stderr.read()
    process = calibrate(
        processes, "offset", str(DATA / "localization" / "test_2"), "--place", "0.5", "1.5", "--target", "0.5", "1.0",
        "--write",
    )  # fmt: skip
    said, error = process.communicate(timeout=240)
    assert process.returncode == 0, error
    assert "only another place can tell them apart" in said
    file = calibration_file.parse((runtime / "of" / "r0.toml").read_text(), "f")
    assert file.distance[0].robot == pytest.approx(0.1255, abs=1e-3)  # uncalibrated: a range of 62.55 cm for 50
