"""Orders to a running simulation: from any datagram, and carried out by processes."""

import socket
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

import msgpack
import pytest
from conftest import wait_until
from hypothesis import given
from hypothesis import strategies as st

from bench.rigs.simulation import Simulation
from sim.control import app_requests
from sim.control.app_requests_server import Orders
from sim.processes.processes import Processes
from swarm import clock
from swarm.app.settings import Setting
from swarm.errors import LocalError, PayloadError
from swarm.messages.codec import encode
from swarm.process.simulations import pid_of
from swarm.recording import trajectory
from swarm.recording.reader import SUFFIX

NAMES = st.from_regex(r"[a-z][a-z0-9_-]{0,15}", fullmatch=True)


@given(st.sampled_from(app_requests.ACTS), NAMES, st.lists(NAMES, min_size=1, max_size=5), st.floats() | st.text())
def test_an_order_comes_as_it_was_given(act: str, app: str, robots: list[str], value: float | str) -> None:
    order = app_requests.check(act, app, robots, [Setting(None, "gain", value).text])
    assert app_requests.unpack(encode(order)) == order


@given(
    st.binary(max_size=60)
    | st.dictionaries(st.sampled_from(["act", "app", "robots", "settings"]), st.integers(-9, 9) | st.text()).map(
        msgpack.packb
    )
)
def test_any_other_datagram_is_refused(datagram: bytes) -> None:
    with pytest.raises(PayloadError, match="no order"):
        app_requests.unpack(datagram)


@pytest.fixture
def simulation(tmp_path: Path):
    """Processes that sleep, and an ear for orders to them: (folder, processes, what it said)."""
    processes = Processes({})
    for name in ("r0", "r1"):
        (tmp_path / name).mkdir()

    def add(robot: str, app: str, settings: Sequence[str]) -> None:
        words = ["timeit", "-n1", "import time; time.sleep(600)", *(f"# {each}" for each in settings)]
        processes.add(robot, f"app/{app}", words, tmp_path / robot)

    ear = Orders(tmp_path, processes, ("r0", "r1"), add)
    yield tmp_path, processes, ear
    ear.close()
    processes.stop()


def told(simulation, act: str, app: str, *robots: str, settings: Sequence[str] = ()) -> str:
    """Give an order, as another process would, while the simulation looks."""
    folder, _, ear = simulation
    answers: list[str] = []

    def give() -> None:
        try:
            answers.append(app_requests.request_app(folder, act, app, robots, settings))
        except LocalError as error:
            answers.append(f"refused: {error}")

    thread = threading.Thread(target=give)
    thread.start()
    while thread.is_alive():
        ear.look()
        thread.join(0.01)
    return answers[0]


def test_apps_start_stop_and_start_again_and_what_was_stopped_stays_so(simulation) -> None:
    _, processes, _ = simulation
    assert told(simulation, "start", "consensus", "r0", "r1") == "consensus: started on r0 r1"
    child = processes.find("r0", "app/consensus")
    first = child.process
    assert told(simulation, "start", "consensus", "r0") == "consensus: started on r0"
    assert child.process is first
    assert told(simulation, "stop", "consensus", "r0") == "consensus: stopped on r0"
    first.wait(60)
    assert processes.supervise(clock.now()) == []
    assert processes.supervise(clock.now() + 60.0) == []
    assert child.process is None
    assert processes.find("r1", "app/consensus").process is not None
    assert told(simulation, "start", "consensus", "r0") == "consensus: started on r0"
    assert child.process is not None
    assert child.restarts == 0


def test_an_app_starts_with_the_settings_of_the_order(simulation) -> None:
    _, processes, _ = simulation
    assert told(simulation, "start", "goto", "r1", settings=["waypoints=1,0.5"]) == "goto: started on r1"
    assert processes.find("r1", "app/goto").command[-1] == "# waypoints=1,0.5"
    assert "is not a setting" in told(simulation, "start", "goto", "r0", settings=["waypoints"])


def test_an_app_that_is_told_to_start_while_it_ends_starts_then(simulation) -> None:
    _, processes, _ = simulation
    told(simulation, "start", "consensus", "r0")
    child = processes.find("r0", "app/consensus")
    first = child.process
    child.hold()
    child.release()
    first.wait(60)
    processes.supervise(clock.now())
    assert child.restart_at is not None
    processes.supervise(child.restart_at)
    assert child.process is not None


@pytest.mark.parametrize(
    ("act", "app", "robots", "said"),
    [
        ("start", "consensus", ["r9"], "no robot r9, there are r0, r1"),
        ("start", "nothing", ["r0"], "no app nothing: expected consensus, "),
        ("stop", "consensus", ["r0"], "consensus does not run on r0"),
    ],
)
def test_what_cannot_be_done_is_answered_in_words(simulation, act, app, robots, said) -> None:
    assert told(simulation, act, app, *robots).startswith(f"refused: {said}")


def test_noise_at_the_door_is_answered_to_who_can_hear_it(simulation) -> None:
    folder, _, ear = simulation
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.sendto(b"\xff", str(folder / app_requests.SOCKET))
        assert ear.look() == []
        sock.bind("")
        sock.sendto(b"\xff", str(folder / app_requests.SOCKET))
        ear.look()
        assert "no order" in msgpack.unpackb(sock.recv(1000))["problem"]


def test_bad_orders_are_refused_before_they_are_given(tmp_path: Path) -> None:
    for act, app, robots in (
        ("fly", "x", ["r0"]),
        ("start", "../x", ["r0"]),
        ("start", "x", []),
        ("start", "x", ["/"]),
    ):
        with pytest.raises(LocalError):
            app_requests.request_app(tmp_path, act, app, robots)
    with pytest.raises(LocalError, match="takes no orders"):
        app_requests.request_app(tmp_path, "start", "x", ["r0"])


@pytest.mark.slow
def test_an_app_of_a_swarm_that_runs_another_one(tmp_path: Path) -> None:
    with Simulation("consensus", "--robots", "2", "--seconds", "600") as simulation:
        simulation.wait_for("r0", 3)
        start = ["app", "start", "led_sync", "--run-dir", str(simulation.run_dir)]
        done = subprocess.run([sys.executable, "-m", "laptop.cli", *start], capture_output=True, text=True, check=True)
        assert done.stdout == "led_sync: started on r0 r1\n"
        simulation.wait_for("r1", 3, app="led_sync")
        process = Path(f"/proc/{pid_of(simulation.run_dir, 'r0', 'app/consensus')}")
        assert process.exists()
        assert "stopped" in app_requests.request_app(simulation.run_dir, "stop", "consensus", ["r0", "r1"])
        wait_until(lambda: not process.exists(), what="the app has ended")
        led = simulation.trajectory("r0", "led_sync").last
        path = simulation.records / f"r0.consensus{SUFFIX}"
        stopped = trajectory.read(path).last
        simulation.wait_for("r0", led + 60, app="led_sync")
        assert trajectory.read(path).last == stopped
        app_requests.request_app(simulation.run_dir, "start", "consensus", ["r0", "r1"])
        wait_until(lambda: trajectory.read(path).last > stopped + 10, timeout=60)
