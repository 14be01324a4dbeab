"""The simulated module at its pseudo-terminal, seen from the robot's end of the wire."""

import math
import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import serial
from dwm_frames import GOLDEN

from services.dwm.core.tlv import LOC_GET, Decoder, Refusal
from services.sim.module import ModuleBoard, modules_of
from swarm.config import Anchor, Config, Dwm, Robot, Simulation

CONFIG = Config(
    path=Path("swarm.toml"),
    network="test",
    robots=(Robot("r0"), Robot("r1")),
    edges=(("r0", "r1"),),
    relay=(),
    anchors=(Anchor("D001", 0.0, 0.0), Anchor("D002", 1.94, 0.0), Anchor("D003", 1.0, 1.94)),
    dwm=Dwm(target="C933"),
    simulation=Simulation(target=(0.5, 1.0), places={"r0": (0.5, 1.5, 0.0)}),
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


def answers(board, port, count, limit=400):
    """Let the board work until `count` answers came."""
    decoder, found = Decoder(LOC_GET), []
    for _ in range(limit):
        board.poll(0.05)
        while select.select([port], [], [], 0)[0]:
            decoder.receive(port.read(4096))
        while (answer := decoder.next()) is not None:
            found.append(answer)
        if len(found) >= count:
            assert decoder.skipped == 0
            return found
    return pytest.fail(f"{len(found)} of {count} answers")


def ask(board, port):
    port.write(LOC_GET.request)
    return answers(board, port, 1)[0]


def test_answers_and_holds_its_measurement(board, port):
    # Asked as fast as it answers, every 10 to 30 ms, it has something new only every 100 ms.
    seen = []
    while len(set(seen)) < 6:
        seen.append(ask(board, port))
    assert len(seen) > 12
    assert {item.anchor for location in seen for item in location.ranges} == {"D001", "D002", "D003", "C933"}


def test_a_request_may_come_in_pieces_and_several_at_once(board, port):
    port.write(b"\x0c")
    board.poll(0.01)
    port.write(b"\x00\x0c\x00\x0c")
    board.poll(0.01)
    port.write(b"\x00")
    assert not any(isinstance(answer, Refusal) for answer in answers(board, port, 3))


def test_half_a_request_is_refused(board, port):
    port.write(b"\x0c")
    assert answers(board, port, 1) == [Refusal(1)]


@pytest.mark.parametrize("request_", [b"\x63\x00", b"\x0c\x01\x03"])
def test_an_unknown_call_is_refused(board, port, request_):
    port.write(request_)
    assert answers(board, port, 1) == [Refusal(1)]


def test_the_pose_decides_what_is_measured(board, port):
    board.update_pose("r0", 1.9, 0.1, 0.0)
    for _ in range(40):
        distances = {item.anchor: item.distance for item in ask(board, port).ranges}
        if distances.get("D002", 9.9) < 0.6:
            assert distances.get("D001", 1.9) > 1.5
            return
    pytest.fail("it never measured at the new place")


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


def test_the_target_is_where_the_simulation_puts_it():
    modules = {module.address: module for module in modules_of(CONFIG)}
    assert (modules["C933"].x, modules["C933"].y) == (0.5, 1.0)
    assert modules["C933"].known.quality == 0
    assert modules["D002"].known.x == 1.94
