"""`swarm dwm` as a user runs it: over a robot's bus, and at a serial port."""

import errno
import json
import math
import os
import threading
import tty
from unittest.mock import Mock

import pytest
import serial
from conftest import CONFIG, wait_until
from dwm_rig import ANCHORS, DWM, working

from services.dwm.core.calibration import calibration_file
from services.dwm.core.calibration.calibration_file import CalibrationFile, described, layout_of
from services.dwm.core.module.calls import NODE_ID_GET, Settings, UpdateRate
from services.dwm.core.module.tlv import NOWHERE, AnchorRange, Position
from services.dwm.line import NoAnswerError, PortLine
from swarm import config as configuration
from swarm.app.ranging import Ranging
from swarm.bus.zenoh_bus import Bus
from swarm.config.types import Anchor
from swarm.errors import LocalError

ROBOTS = CONFIG.replace('name = "r1"', 'name = "r1"\nuwb = "DE01"\nuwb_role = "anchor"')


@pytest.fixture
def config(processes, runtime):
    processes.config.write_text(ROBOTS.format(runtime=runtime) + ANCHORS + DWM.format(directory=runtime))
    return configuration.load(processes.config)


@pytest.fixture
def board(runtime, config):
    with working(runtime, config, "r0", "r1") as board:
        yield board


@pytest.fixture
def run(processes):
    """Run what `swarm dwm ...` becomes; gives exit code, what it said, and on stderr."""

    def run(*arguments, answer=""):
        process = processes.start("-m", "laptop.cli", "dwm", *map(str, arguments))
        said, error = process.communicate(answer, timeout=60)
        assert "Traceback" not in error
        return process.returncode, json.loads(said or "null") if "--json" in arguments else said, error

    return run


@pytest.fixture
def service(processes, router, board):
    return processes.start_ready("-m", "services.dwm")


def anchor(runtime, address):
    return str(runtime / "anchors" / f"{address}.tty")


def test_a_robots_module_through_its_service(run, service, board):
    code, told, _ = run("info", "--json")
    assert code == 0
    assert (told["r0"]["address"], told["r0"]["role"], told["r0"]["firmware"]) == ("DE00", "tag", "1.3.0")
    assert (told["r0"]["moving"], told["r0"]["still"]) == (0.1, 0.1)
    code, said, _ = run("check", "--seconds", "1")
    assert (code, said) == (0, "r0: all is well\n")
    code, told, _ = run("anchors", "--json", "--seconds", "1")
    assert code == 0
    assert told["r0"]["D001"]["distance"] == pytest.approx(math.hypot(0.5, 1.5), abs=0.3)
    assert told["r0"]["D001"]["said"] == [0.0, 0.0, 0.0]
    assert told["r0"]["C933"]["listed"] is None


def test_the_distance_to_a_robot_that_carries_an_anchor(run, service, board, runtime):
    board.update_pose("r1", 0.6, 1.5, 0.0)
    with Bus.of(runtime) as bus:
        ranging = Ranging(bus, "r0")
        wait_until(lambda: ranging.distance("r1") is not None, what="a distance")
        assert ranging.distance("r1") == pytest.approx(0.1, abs=0.5)
        assert {item.robot for item in ranging.ranges} == {None, "r1"}
    code, told, _ = run("anchors", "--json", "--seconds", "1")
    assert code == 0
    assert told["r0"]["DE01"]["robot"] == "r1"


def test_a_module_as_it_comes_is_set_up_over_the_bus(run, service, board):
    """Stationary detection and 10 s when still: a balanced robot would get a place every 10 s."""
    module = board.module("r0")
    module.settings = module.flash.settings = Settings(anchor=False, stationary=True)
    module.flash.rate = UpdateRate(1, 100)
    code, told, _ = run("check", "--json", "--seconds", "1")
    assert code == 1
    assert [finding["code"] for finding in told["r0"] if finding["fatal"]] == ["still"]
    code, told, _ = run("configure", "--json")
    assert code == 0, told
    assert told["r0"]["missing"] == []
    assert len(told["r0"]["changes"]) == 2
    assert (module.settings, module.flash.rate) == (Settings(anchor=False), UpdateRate(1, 1))
    code, said, _ = run("configure")
    assert (code, said) == (0, "r0 DE00: is as it shall be\n")


def test_without_a_service_it_says_so(run, router, config):
    code, told, _ = run("check", "--json")
    (finding,) = told["r0"]
    assert (code, finding["code"]) == (1, "no-module")
    assert "its dwm service does not answer" in finding["text"]


def test_a_comparison_with_the_truth_says_that_a_bus_does_not_answer(run, config):
    code, _, error = run("check", "--truth", "sim", "--seconds", 1)
    assert code == 2
    assert "r0: its bus does not answer: does its bus service run?" in error


def test_a_calibration_of_other_anchors_is_named_though_the_service_does_not_run(run, router, processes, runtime):
    text = DWM.replace("target =", 'calibration = "of/{{robot}}.toml"\ntarget =', 1).format(directory=runtime)
    processes.config.write_text(ROBOTS.format(runtime=runtime) + ANCHORS + text)
    calibrated = (Anchor("D001", 0.0, 0.0), Anchor("D002", 1.90, 0.0), Anchor("D003", 1.0, 1.94))
    file = CalibrationFile("r0", layout_of(calibrated), described(calibrated))
    (runtime / "of").mkdir()
    (runtime / "of" / "r0.toml").write_text(calibration_file.text_of(file))
    code, told, error = run("check", "--json")
    assert code == 1, error
    assert [finding["code"] for finding in told["r0"]] == ["no-module", "calibration"]
    assert "anchors" in told["r0"][1]["text"]


def test_a_port_that_a_service_owns_is_not_taken(run, service, runtime):
    code, _, error = run("info", "--port", runtime / "r0" / "dwm.tty")
    assert code == 2
    assert "a service owns it" in error


def test_at_a_port_roles_and_places_come_from_swarm_toml(run, board, runtime):
    module = board.module("D002")
    module.settings = module.flash.settings = Settings(anchor=False)
    module.flash.place = Position(9.0, 9.0, 0.0, 100)
    code, told, _ = run("check", "--port", anchor(runtime, "D002"), "--json", "--seconds", "0.5")
    assert code == 1
    assert "role" in [finding["code"] for (findings) in told.values() for finding in findings]
    code, said, _ = run("configure", "--port", anchor(runtime, "D002"))
    assert code == 0
    assert "tag -> anchor" in said
    assert module.settings.anchor
    assert module.flash.place == Position(1.94, 0.0, 0.0, 100)
    code, _, _ = run("configure", "--port", runtime / "r1" / "dwm.tty", "--anchor", "--initiator", "--at", 1, 2, 0.5)
    assert code == 0
    assert board.module("r1").settings.initiator
    assert board.module("r1").flash.place == Position(1.0, 2.0, 0.5, 100)


def test_a_module_in_shell_mode_is_found_and_told_to_leave_it(run, board, runtime):
    board.module("D001").in_shell = True
    code, told, _ = run("info", "--port", anchor(runtime, "D001"), "--json")
    assert code == 0
    assert [fields["address"] for fields in told.values()] == ["D001"]
    assert not board.module("D001").in_shell


class Noise:
    """A port at which something else than a DWM1001 answers."""

    def __init__(self, answer):
        self.near, self.far = os.openpty()
        tty.setraw(self.far)
        self.path = os.ttyname(self.far)
        self._answer = answer
        self._thread = threading.Thread(target=self._work)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        os.write(self.far, b"\xff")
        self._thread.join()
        os.close(self.near)
        os.close(self.far)

    def _work(self):
        while (data := os.read(self.near, 4096)) and not data.endswith(b"\xff"):
            os.write(self.near, self._answer)


@pytest.mark.parametrize(
    ("answer", "code", "words"),
    [
        (b"", "no-module", "does not answer"),
        (bytes(range(0x80, 0xF0)), "garbled", "wrong baud rate"),
        (b"\r\nlogin: ", "shell-mode", "shell mode"),
        (bytes.fromhex("400100 500c 01000301000000000000000000"), "layout", "layout (ver_get: part 50 of 12 bytes"),
        (bytes.fromhex("400104"), "refused", "busy"),
    ],
)  # fmt: skip
def test_what_is_no_module_is_named(run, config, answer, code, words):
    with Noise(answer) as noise:
        ended, told, _ = run("check", "--port", noise.path, "--json")
    (finding,) = told[noise.path]
    assert ended == 1
    assert finding["code"] == code
    assert words in finding["text"]
    assert finding["remedy"]


def test_a_port_that_is_not_there(run):
    code, _, error = run("check", "--port", "/dev/nothing")
    assert code == 2
    assert "/dev/nothing: No such file" in error


def test_a_port_that_the_user_may_not_open_is_told_with_the_group_that_may(monkeypatch):
    refused = serial.SerialException(errno.EACCES, "could not open port /dev/ttyACM0")
    monkeypatch.setattr(serial, "Serial", Mock(side_effect=refused))
    with pytest.raises(LocalError, match="/dev/ttyACM0: Permission denied; is this user in the group dialout"):
        PortLine("/dev/ttyACM0")


def test_a_module_that_is_unplugged_meanwhile(board, runtime):
    line = PortLine(anchor(runtime, "D001"))
    assert line.ask(NODE_ID_GET) & 0xFFFF == 0xD001
    board.remove("D001")
    with pytest.raises(NoAnswerError, match=r"D001\.tty"):
        line.ask(NODE_ID_GET)
    line.close()


@pytest.mark.slow
def test_anchors_take_turns_and_are_laid_out(run, board, runtime):
    ports = [word for address in ("D001", "D002", "D003") for word in ("--port", anchor(runtime, address))]
    code, told, error = run("anchors", "--auto", "--seconds", "2", "--json", *ports)
    assert code == 0, error
    places = {"D001": (0.0, 0.0), "D002": (1.94, 0.0), "D003": (1.0, 1.94)}
    for address, place in places.items():
        assert told["anchors"][address] == pytest.approx(place, abs=0.08)
        assert board.module(address).settings.anchor
    assert [a for a in places if board.module(a).settings.initiator] == ["D001"]
    assert told["rms"] < 0.1


def test_the_phone_apps_auto_positioning_is_used_where_it_was_done(run, board, runtime):
    places = {"D001": (0.0, 0.0), "D002": (1.94, 0.0), "D003": (1.0, 1.94)}
    for address, place in places.items():
        board.module(address).survey = tuple(
            AnchorRange(other, (math.dist(place, there) + 0.05964849) / 0.946976, 100, NOWHERE)
            for other, there in places.items()
            if other != address
        )
    ports = [word for address in places for word in ("--port", anchor(runtime, address))]
    code, told, error = run("anchors", "--auto", "--json", *ports)
    assert code == 0
    assert "auto-positioning are there" in error
    for address, place in places.items():
        assert told["anchors"][address] == pytest.approx(place, abs=0.003)


@pytest.mark.slow
def test_a_tag_is_carried_from_anchor_to_anchor(run, service, board, processes):
    process = processes.start("-m", "laptop.cli", "dwm", "anchors", "--auto", "--seconds", "2", "--json")
    for place in ((0.0, 0.0), (1.94, 0.0), (1.0, 1.94)):
        assert "beside anchor" in process.stderr.readline()
        board.update_pose("r0", *place, 0.0)
        process.stdin.write("\n")
        process.stdin.flush()
    said, error = process.communicate(timeout=60)
    assert process.returncode == 0, error
    assert json.loads(said)["anchors"]["D003"] == pytest.approx((1.0, 1.94), abs=0.1)
    code, _, error = run("anchors", "--auto", "--seconds", "0.8")
    assert code == 2
    assert "asks for each anchor" in error


def test_anchors_are_placed_by_distances_from_a_file(run, tmp_path):
    path = tmp_path / "ranges.txt"
    path.write_text("# by laser\nA001 A002 2\nA001 A003 2.5\n\nA002 A003 1.5\n")
    code, said, _ = run("anchors", "--auto", "--ranges", path)
    assert code == 0
    assert 'address = "A003"\nx = 2.000\ny = 1.500' in said
    path.write_text("A001 A002\n")
    code, _, error = run("anchors", "--auto", "--ranges", path)
    assert code == 2
    assert "ranges.txt:1: expected two addresses" in error
