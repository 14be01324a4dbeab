"""The simulated module at its pseudo-terminal, seen from the robot's end of the wire."""

import math
import os
import select
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import serial
from dwm_frames import GOLDEN

from services.dwm.core.module.calls import CFG_GET, POS_GET, RESET, Settings, cfg_set
from services.dwm.core.module.tlv import LOC_GET, NOWHERE, Location, Position, Refusal, TlvDecoder
from sim.devices.module import ModuleBoard
from swarm import clock
from swarm.config import Anchor, Config, Dwm, RobotConfig, SimulationConfig

CONFIG = Config(
    path=Path("swarm.toml"),
    network="test",
    robots=(RobotConfig("r0"), RobotConfig("r1")),
    edges=(("r0", "r1"),),
    relay=(),
    anchors=(Anchor("D001", 0.0, 0.0), Anchor("D002", 1.94, 0.0), Anchor("D003", 1.0, 1.94)),
    dwm=Dwm(target="C933"),
    simulation=SimulationConfig(target=(0.5, 1.0), places={"r0": (0.5, 1.5, 0.0)}),
)


@pytest.fixture
def board(tmp_path):
    board = ModuleBoard(tmp_path, CONFIG, 1)
    board.add("r0")
    yield board
    board.close()
    assert not (tmp_path / "r0" / "dwm.tty").exists()


@pytest.fixture
def port(board, tmp_path):
    with serial.Serial(str(tmp_path / "r0" / "dwm.tty"), 115200, timeout=0, exclusive=True) as port:
        yield port


def answers(board, port, count, limit=200, call=LOC_GET, tolerant=False):
    """Let the board work until `count` answers came."""
    decoder, found = TlvDecoder(call), []
    for _ in range(limit):
        board.poll(0.05)
        while select.select([port], [], [], 0)[0]:
            decoder.receive(port.read(4096))
        while (answer := decoder.next()) is not None:
            found.append(answer)
        if call.parts == () and decoder.raw:
            return [answer]
        if len(found) >= count:
            assert decoder.skipped == 0
            return found
    if tolerant:
        return []
    return pytest.fail(f"{len(found)} of {count} answers")


def ask(board, port, call=LOC_GET):
    port.write(call.request)
    return answers(board, port, 1, call=call)[0]


def test_answers_and_holds_its_measurement(board, port):
    # Asked as fast as it answers, every 10 to 30 ms, it has something new only every 100 ms.
    first_seen: dict[Location, float] = {}
    while len(first_seen) < 8:
        location = ask(board, port)
        first_seen.setdefault(location, clock.now())
    times = list(first_seen.values())
    assert times[-1] - times[1] > 0.4  # six measurements later, the first of which we may have seen late
    assert {item.anchor for location in first_seen for item in location.ranges} == {"D001", "D002", "D003", "C933"}


def test_several_requests_at_once_are_answered_one_after_the_other(board, port):
    port.write(LOC_GET.request * 3)
    assert not any(isinstance(answer, Refusal) for answer in answers(board, port, 3))


def test_half_a_request_is_refused(board, port):
    port.write(b"\x0c")
    assert answers(board, port, 1) == [Refusal(1)]


def test_the_pose_decides_what_is_measured(board, port):
    board.update_pose("r0", 1.9, 0.1, 0.0)
    for _ in range(40):
        distances = {item.anchor: item.distance for item in ask(board, port).ranges}
        if distances.get("D002", 9.9) < 0.6:
            assert distances.get("D001", 1.9) > 1.5
            return
    pytest.fail("it never measured at the new place")


def test_antennas_are_at_the_configured_height(tmp_path):
    anchors = tuple(replace(anchor, z=30.0) for anchor in CONFIG.anchors)
    board = ModuleBoard(tmp_path, replace(CONFIG, anchors=anchors, dwm=replace(CONFIG.dwm, height=30.0)), 1)
    board.add("r0")
    board.update_pose("r0", 1.0, 1.0, 0.0)
    ranges = ()
    with serial.Serial(str(tmp_path / "r0" / "dwm.tty"), 115200, timeout=0, exclusive=True) as line:
        while not ranges:
            ranges = ask(board, line).ranges
    board.close()
    assert all(item.distance < 5.0 for item in ranges)


def test_without_a_pose_it_sees_nothing(board, tmp_path):
    board.add("r1")
    with serial.Serial(str(tmp_path / "r1" / "dwm.tty"), 115200, timeout=0) as port:
        location = ask(board, port)
    assert (location.position.quality, location.ranges) == (0, ())


def test_survives_who_reads_it(board, tmp_path):
    """Opened and closed again and again, killed in the middle of an answer, and there for the next."""
    path = tmp_path / "r0" / "dwm.tty"
    for _ in range(5):
        with serial.Serial(str(path), 115200, timeout=0, exclusive=True) as port:
            port.write(LOC_GET.request)
            board.poll(0.0)
    program = f"import os, signal; os.write(os.open({str(path)!r}, os.O_RDWR | os.O_NOCTTY), b'\\x0c\\x00\\x0c')"
    process = subprocess.run([sys.executable, "-c", program + "; os.kill(0 or os.getpid(), 9)"], check=False)
    assert process.returncode == -signal.SIGKILL
    for _ in range(20):
        board.poll(0.01)
    with serial.Serial(str(path), 115200, timeout=0, exclusive=True) as port:
        port.reset_input_buffer()
        assert len(ask(board, port).ranges) >= 1


def test_a_reader_that_does_not_read_costs_only_itself(board, port):
    for _ in range(200):
        port.write(LOC_GET.request * 40)
        board.poll(0.001)
    port.reset_input_buffer()


def test_a_loop_of_its_own_can_wait_for_it(board, port):
    port.write(LOC_GET.request)
    assert select.select([board.fileno()], [], [], 5)[0]
    assert math.isfinite(board.next_deadline())
    assert len(GOLDEN) == 101


def test_unplugged_it_is_gone_and_the_name_is_free(board, tmp_path):
    path = tmp_path / "r0" / "dwm.tty"
    with serial.Serial(str(path), 115200, timeout=0) as port:
        board.remove("r0")
        assert not os.path.lexists(path)
        with pytest.raises(OSError, match=r"."):
            port.write(LOC_GET.request)
    board.add("r0")
    with serial.Serial(str(path), 115200, timeout=0) as port:
        while not ask(board, port).ranges:
            pass  # it has yet to measure


def test_anchors_and_target_are_at_ports_of_their_own(board, tmp_path):
    found = {}
    for path in sorted((tmp_path / "anchors").iterdir()):
        with serial.Serial(str(path), 115200, timeout=0, exclusive=True) as line:
            found[path.stem] = ask(board, line, CFG_GET), ask(board, line, POS_GET)
    assert [settings.anchor for settings, _ in found.values()] == [True] * 4
    assert [address for address, (settings, _) in found.items() if settings.initiator] == ["D001"]
    assert found["D002"][1] == Position(1.94, 0.0, 0.0, 100)
    assert found["C933"][1].quality == 0


@pytest.mark.slow
def test_an_anchor_that_is_made_a_tag_takes_its_turn_at_ranging(board, tmp_path):
    with serial.Serial(str(tmp_path / "anchors" / "D002.tty"), 115200, timeout=0, exclusive=True) as line:
        ask(board, line, cfg_set(Settings(anchor=False)))
        ask(board, line, RESET)
        while board.module("D002").settings.anchor:
            board.poll(0.05)
        location = Location(NOWHERE, ())
        while len(location.ranges) < 3:
            line.write(LOC_GET.request)
            for answer in answers(board, line, 1, tolerant=True):
                location = answer
    assert {item.anchor for item in location.ranges} == {"C933", "D001", "D003"}
    (to_first,) = [item.distance for item in location.ranges if item.anchor == "D001"]
    assert to_first == pytest.approx(1.94 * 1.056 + 0.063, abs=0.7)


def test_a_robot_as_an_anchor_is_ranged_by_the_others(tmp_path):
    robots = (RobotConfig("r0", uwb="DE00"), RobotConfig("r1", uwb="DE01", uwb_role="anchor"))
    places = {"r0": (0.5, 1.5, 0.0), "r1": (0.6, 1.5, 0.0)}
    config = replace(CONFIG, robots=robots, simulation=replace(CONFIG.simulation, places=places))
    board = ModuleBoard(tmp_path, config, 1)
    board.add("r0")
    board.add("r1")
    seen = {}
    with serial.Serial(str(tmp_path / "r0" / "dwm.tty"), 115200, timeout=0, exclusive=True) as line:
        while "DE01" not in seen:
            seen = {item.anchor: item for item in ask(board, line).ranges}
    board.close()
    assert seen["DE01"].distance == pytest.approx(0.1 * 1.056 + 0.063, abs=0.6)
    assert seen["DE01"].position.quality == 0


def test_an_accelerometer_feels_the_robot_move(board):
    module = board.module("r0")
    before = module._moved
    board.update_pose("r0", 0.505, 1.5, 0.0)
    assert module._moved == before
    board.update_pose("r0", 0.6, 1.5, 0.0)
    assert module._moved > before
