"""The dwm process between a real router and a real pseudo-terminal."""

import json
import signal
import statistics
import time
from dataclasses import replace
from itertools import pairwise

import pytest
from conftest import CONFIG, stop, wait_until
from dwm_rig import ANCHORS, working

from services.dwm.core.calibration.calibration_file import CalibrationFile, Evidence, layout_of, text_of
from services.dwm.core.calibration.models import RangeModel
from swarm import clock
from swarm import config as configuration
from swarm.bus.zenoh_bus import Bus
from swarm.messages import Measurement, Odometry, read
from swarm.messages.codec import decode
from swarm.recording.thesis_ranges import cost

LIVE = (
    ANCHORS
    + """[dwm]
source = "serial:{directory}/{{robot}}/dwm.tty"
target = "C933"
window = 10
distance = {{ gain = 0.946976, offset = -0.05964849 }}
[dwm.position]
matrix = [[0.93538932, 0.00353817], [-0.01071457, 0.94470965]]
offset = [0.046239576, 0.050861534]
[simulation]
target = [0.5, 1.0]
[simulation.places]
r0 = [0.5, 1.5, 0.0]
"""
)
ROWS = [(62.4, 43.9, 152.6), (62.5, 44.0, 152.7), (63.0, 44.1, 152.8)]


class Ear:
    """All that the dwm service of r0 says."""

    def __init__(self, bus):
        self.ranges, self.poses, self.states = [], [], []
        self._of = {"ranges": self.ranges, "pose": self.poses, "status": self.states}
        bus.subscribe("swarm/r0/dwm/*", lambda key, data: self._of[key.split("/")[-1]].append(read(key, data)))

    def state(self):
        return (self.states[-1].state, self.states[-1].reason) if self.states else ("", "")


@pytest.fixture
def bus(router, runtime):
    with Bus.of(runtime) as bus:
        assert bus.wait_connected(60)
        yield bus


@pytest.fixture
def ear(bus):
    return Ear(bus)


@pytest.fixture
def board(processes, runtime):
    """Simulated modules in a thread of their own, as in a simulation; r0 has one."""
    processes.config.write_text(CONFIG + LIVE.format(directory=runtime))
    with working(runtime, configuration.load(processes.config), "r0") as board:
        yield board


def test_ranges_and_pose_come_calibrated_at_10_hz(processes, board, ear):
    process = processes.start_ready("-m", "services.dwm")
    wait_until(
        lambda: len(ear.ranges) >= 40 and ear.state()[0] == "ready",
        what=lambda: f"40 reports and ready: {len(ear.ranges)} reports, {len(ear.poses)} poses, {ear.states[-3:]}",
    )
    ranges, poses = ear.ranges[:], ear.poses[:]
    # 10 Hz at most, whatever the machine's load makes of it
    assert (len(ranges) - 1) / (ranges[-1].t - ranges[0].t) < 10.5
    assert statistics.median(b.t - a.t for a, b in pairwise(ranges)) == pytest.approx(0.1, abs=0.03)
    assert [item.sequence for item in ranges] == sorted(item.sequence for item in ranges)
    assert {item.anchor for report in ranges for item in report.ranges} == {"D001", "D002", "D003", "C933"}
    to_target = [item for report in ranges for item in report.ranges if item.anchor == "C933"]
    assert statistics.median(item.raw for item in to_target) == pytest.approx(0.591, abs=0.06)
    assert statistics.median(item.distance for item in to_target) == pytest.approx(0.5, abs=0.06)
    fixes = [pose for pose in poses if pose.quality > 0]
    assert statistics.median(pose.x for pose in fixes) == pytest.approx(0.5, abs=0.12)
    assert statistics.median(pose.y for pose in fixes) == pytest.approx(1.5, abs=0.12)
    assert stop(process) == 0


class Wheels:
    """Odometry as the balancer tells it, of a robot that drives and sends its true place to the module."""

    def __init__(self, bus, board):
        self.bus, self.board = bus, board
        self.x, self.y, self.t0 = 0.5, 1.5, clock.now()
        self.sequence, self.rolled, self.t = 0, 0.0, self.t0

    def step(self, speed):
        now = clock.now()
        self.rolled += speed * (now - self.t)
        self.x, self.t = 0.5 + self.rolled, now
        self.sequence += 1
        self.board.update_pose("r0", self.x, self.y, 0.0)
        told = Odometry(now, self.sequence, self.rolled, self.rolled, self.rolled, 0.0, 0.0, 0.0, 0.0, 0.0)
        self.bus.publish("swarm/r0/balancer/odometry", told)


def test_with_odometry_the_pose_is_the_kalman_filters(processes, board, ear, bus):
    processes.start_ready("-m", "services.dwm")
    wheels = Wheels(bus, board)

    def driven(speed, condition):
        wheels.step(speed)
        time.sleep(0.03)
        return condition()

    def tracked():
        return [pose for pose in ear.poses if pose.source == "ekf"]

    wait_until(lambda: driven(0.0, lambda: len(tracked()) >= 10), what="poses of a standing robot")
    assert tracked()[-1].heading is None
    wait_until(lambda: driven(0.25, lambda: wheels.rolled > 0.9), what="0.9 m")

    def caught_up():
        last = tracked()[-1]
        return (last.x, last.y) == pytest.approx((wheels.x, wheels.y), abs=0.15)

    wait_until(lambda: driven(0.0, caught_up), what="the pose where the wheels have stopped")  # at once, unless busy
    last = tracked()[-1]
    assert last.heading == pytest.approx(0.0, abs=0.5)
    assert 0 < last.deviation_x < 0.15


def test_a_calibration_is_loaded_and_one_of_other_anchors_refused(processes, board, ear, runtime):
    anchors = configuration.load(processes.config).anchors
    text = processes.config.read_text()
    processes.config.write_text(text.replace("window = 10", 'window = 10\ncalibration = "{robot}.toml"', 1))
    process = processes.start_ready("-m", "services.dwm")
    wait_until(lambda: ear.ranges and ear.ranges[-1].ranges, what="a range without a calibration")
    item = ear.ranges[-1].ranges[0]
    assert item.distance == pytest.approx(item.raw, abs=1.0)
    assert stop(process) == 0
    assert "there is no calibration" in (said := process.stderr.read())
    assert "swarm calibrate distance --robots r0" in said
    ear.ranges.clear()
    evidence = Evidence("linear", "2026-11-21T06:00:00", 3, 9, "00", {}, 0.0, ())
    file = CalibrationFile("r0", layout_of(anchors), (), (RangeModel(1.0, 5.0), evidence))
    (runtime / "r0.toml").write_text(text_of(file))
    process = processes.start_ready("-m", "services.dwm")
    wait_until(lambda: ear.ranges and ear.ranges[-1].ranges, what="a range")
    item = ear.ranges[-1].ranges[0]
    assert item.distance > 5.0 + item.raw - 1.0
    assert stop(process) == 0
    (runtime / "r0.toml").write_text(text_of(replace(file, layout="0" * 16)))
    process = processes.start("-m", "services.dwm")
    assert process.wait(60) == 2
    error = process.stderr.read()
    assert "was made with other anchors" in error
    assert "Traceback" not in error


def test_a_module_that_vanishes_and_comes_back(processes, board, ear):
    processes.start_ready("-m", "services.dwm")
    wait_until(lambda: ear.ranges, what="ranges")
    board.remove("r0")
    wait_until(lambda: ear.state()[0] == "degraded", what="degraded")
    wait_until(lambda: "dwm.tty" in ear.state()[1] and "No such file" in ear.state()[1], what="its reason")
    seen = ear.ranges[-1].sequence
    board.add("r0")
    wait_until(lambda: ear.state() == ("ready", ""), what="ready again")
    wait_until(lambda: ear.ranges[-1].sequence > seen, what="new ranges with the sequence going on")


def test_killed_it_starts_again_at_the_same_module(processes, board, ear):
    first = processes.start_ready("-m", "services.dwm")
    wait_until(lambda: len(ear.ranges) > 3, what="ranges")
    first.send_signal(signal.SIGKILL)
    first.wait()
    del ear.ranges[:]
    processes.start_ready("-m", "services.dwm")
    wait_until(lambda: len(ear.ranges) > 3, what="ranges of the second process")


def test_a_port_without_a_module_is_told(processes, board, ear, runtime):
    """A terminal at which nobody answers; the service says what is wrong and still ends at once."""
    text = processes.config.read_text()
    processes.config.write_text(text.replace("dwm.tty", "other.tty"))
    (runtime / "r0" / "other.tty").symlink_to("/dev/ptmx")  # a new pseudo-terminal whose other end nobody has
    process = processes.start_ready("-m", "services.dwm")
    wait_until(lambda: ear.state()[0] == "degraded", what="degraded")
    assert "other.tty" in ear.state()[1]
    assert stop(process) == 0


def test_the_dwm_service_starts_before_the_bus(processes, runtime, board):
    process = processes.start("-m", "services.dwm")
    processes.router()
    with Bus.of(runtime) as bus:
        ear = Ear(bus)
        wait_until(lambda: ear.ranges, what="ranges")
    assert stop(process) == 0


class Recorded:
    """A recording of two robots, and questions to the process that replays it."""

    def __init__(self, processes, runtime, bus):
        self.bus = bus
        directory = runtime / "recording"
        directory.mkdir()
        for robot in range(2):
            lines = ["100.5,0,0,0,0,0,0"]
            for k, (distance, x, y) in enumerate(ROWS):
                state = f"{101 + k},0,0,0,0,0,0"
                told = cost(distance + robot, 0.0, 0.0, x, y)
                lines += [f"{state},{flag},{told},{distance + robot},{x},{y}" for flag in (0, 1)]
            (directory / f"{robot}.csv").write_text("\n".join(lines) + "\n")
        processes.config.write_text(CONFIG + '[dwm]\nsource = "replay:recording"\ntarget = "C933"\n')

    def ask(self, sequence):
        """The payloads of all answers to one question that is repeated until one comes, or the status moves on."""
        answers = []

        def answered():
            if not answers:
                self.bus.ask("swarm/r0/dwm/measurement", lambda _, data: answers.append(data), sequence=sequence)
                time.sleep(0.05)
            return answers

        wait_until(answered, what=f"row {sequence}")
        return answers[0]


@pytest.fixture
def recorded(processes, runtime, bus):
    return Recorded(processes, runtime, bus)


def test_replay_answers_rows_and_publishes_each_once(processes, recorded, ear):
    processes.start_ready("-m", "services.dwm")
    answers = [recorded.ask(k) for k in (0, 1, 1, 0, 2)]
    messages = [decode(Measurement, data, "answer") for data in answers]
    assert [message.sequence for message in messages] == [0, 1, 1, 0, 2]
    assert [(m.distance, m.x, m.y) for m in messages[:2]] == [(0.624, 0.439, 1.526), (0.625, 0.44, 1.527)]
    assert answers[1] == answers[2]
    assert answers[0] == answers[3]
    wait_until(lambda: len(ear.poses) == 3, what="the published rows")
    assert [item.sequence for item in ear.ranges] == [0, 1, 2]
    assert [(pose.sequence, pose.x, pose.y, pose.source) for pose in ear.poses[:1]] == [(0, 0.439, 1.526, "recording")]
    (item,) = ear.ranges[0].ranges
    assert (item.anchor, item.distance, item.raw, item.sequence) == ("C933", 0.624, 0.624, 0)


def test_replay_answers_the_same_after_a_kill(processes, recorded):
    first = processes.start_ready("-m", "services.dwm")
    before = recorded.ask(1)
    first.send_signal(signal.SIGKILL)
    first.wait()
    processes.start_ready("-m", "services.dwm")
    assert recorded.ask(1) == before


def test_replay_is_silent_past_the_end_and_to_nonsense(processes, recorded, bus):
    process = processes.start_ready("-m", "services.dwm")
    recorded.ask(2)
    counters = {}

    def counted():
        bus.ask("swarm/r0/dwm/status", lambda key, data: counters.update(read(key, data).counters))
        time.sleep(0.05)
        return counters.get("past_end", 0) >= 1 and counters.get("wrong_queries", 0) >= 4

    def unexpected(_, data):
        counters["answered"] = data

    bus.ask("swarm/r0/dwm/measurement", unexpected, sequence=3)
    for text in ("-1", "x", "1e3", "9" * 40):
        bus.ask("swarm/r0/dwm/measurement", unexpected, sequence=text)
    wait_until(counted, what="the counters")
    assert "answered" not in counters
    assert stop(process) == 0
    assert "row 3 was asked for, the recording ends at row 2" in process.stderr.read()


@pytest.mark.parametrize(
    ("prepare", "words"),
    [
        (lambda path: (path / "0.csv").write_text("1,2,3\n"), "0.csv:1: 3 columns"),
        (lambda path: (path / "0.csv").unlink(), "0.csv: missing"),
        (lambda path: path.rename(path.with_name("away")), "there is no such folder"),
    ],
)
def test_a_wrong_recording_ends_it_with_one_line(processes, recorded, runtime, prepare, words):
    prepare(runtime / "recording")
    process = processes.start("-m", "services.dwm")
    assert process.wait(60) == 2
    error = process.stderr.read()
    assert words in error
    assert "Traceback" not in error


def test_the_dwm_process_loads_neither_numpy_nor_asyncio(processes, board, ear):
    """Robot-side memory is scarce: neither numpy nor asyncio, and no thread per concern."""
    names = json.dumps(["numpy", "asyncio"])
    program = f"import sys, services.dwm.__main__, serial; print([n for n in {names} if n in sys.modules])"
    assert processes.start("-c", program).communicate()[0].strip() == "[]"
