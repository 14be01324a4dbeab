"""The programs of the pages about other tools run against a simulation and its recording."""

import contextlib
import re
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import wait_until
from needs import needs_ssh

from bench.rigs.fake_robots import FakeRobots
from bench.rigs.running import running
from swarm.bus.zenoh_bus import Bus
from swarm.messages import Pose, read

ROOT = Path(__file__).parents[3]
PAGES = ("how-to/tools/zenoh-client.md", "how-to/runs/export.md", "reference/overlays-client.md")
PROGRAM = re.compile(r"^```python (\S+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PROGRAMS = dict(PROGRAM.findall("".join((ROOT / "docs" / page).read_text(encoding="utf-8") for page in PAGES)))

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


@pytest.fixture
def simulation(tmp_path: Path) -> Iterator[Path]:
    """The folder of a simulation that runs."""
    words = ("sim", "consensus", "--robots", "2", "--seconds", "120", "--run-dir", tmp_path / "run")
    with running([sys.executable, "-m", "laptop.cli", *words], cwd=ROOT, stdout=subprocess.DEVNULL):
        yield tmp_path


def run_program(name: str, folder: Path, *arguments: object) -> str:
    path = folder / name
    path.write_text(PROGRAMS[name])
    words = [sys.executable, path, *map(str, arguments)]
    done = subprocess.run(words, check=False, capture_output=True, text=True, timeout=240)
    return done.stdout + done.stderr


def until_said(program: str, folder: Path, text: str, *arguments: object) -> None:
    """Run a program until it shows what it looks for: a simulation has to start."""
    for _ in range(100):
        if text in (shown := run_program(program, folder, *arguments)):
            return
    pytest.fail(f"{program} never showed {text}: {shown}")


def test_a_stock_zenoh_client_reads_an_apps_state(simulation: Path) -> None:
    until_said("client.py", simulation, "'value':", simulation / "run" / "r0" / "bus.sock", 3)


def test_a_program_beside_the_apps_floods_and_sends(simulation: Path) -> None:
    until_said("flood.py", simulation, "delivered=True", simulation / "run")
    said = run_program("flood.py", simulation, simulation / "run")
    assert "flood from r0 b'hello'" in said
    assert "robots=('r1',), complete=True" in said
    assert "message from r0 b'psst'" in said


@needs_ssh
def test_a_stock_zenoh_client_reads_a_robots_bus_through_ssh(simulation: Path) -> None:
    robots = FakeRobots(simulation)
    robots.add("r0")
    robots.ready()
    (line,) = re.findall(r"^ssh (-N -L .*) &$", (ROOT / "docs" / PAGES[0]).read_text(encoding="utf-8"), re.MULTILINE)
    near = simulation / "r0.sock"
    words = line.replace("/tmp/r0.sock", str(near)).replace("/run/swarm/bus.sock", str(simulation / "run/r0/bus.sock"))
    wait_until((simulation / "run/r0/bus.sock").is_socket, what="the bus of the simulation")
    with contextlib.closing(robots), running(["ssh", "-F", str(robots.ssh_config), *words.split()]):
        wait_until(near.is_socket, what="the forwarded socket")
        until_said("client.py", simulation, "'value':", near, 3)


def test_pandas_reads_a_recording_through_the_makers_reader(tmp_path: Path) -> None:
    words = ("sim", "consensus", "--virtual", "--robots", "2", "--iterations", "5", "--record", tmp_path / "recorded")
    subprocess.run([sys.executable, "-m", "laptop.cli", *map(str, words)], check=True, cwd=ROOT, capture_output=True)
    (recording,) = (tmp_path / "recorded").rglob("*.mcap")
    assert "state.value" in run_program("table.py", tmp_path, recording)


CAPTURED = """
network = "lab"
robots = [{ name = "r0" }, { name = "r1" }]
topology = { shape = "line" }
anchors = [
    { address = "D001", x = 0.0, y = 0.0, z = 0.3 },
    { address = "D002", x = 2.0, y = 0.0, z = 0.3 },
    { address = "D003", x = 1.0, y = 2.0, z = 0.3 },
]
dwm = { source = "bus:swarm/{robot}/dwm/set/report" }
"""
NATNET = 1511
"""The port of Motive's stream."""


def natnet_frame(body: int, x: float, y: float) -> bytes:
    """A frame of mocap data of NatNet 3 with no marker and one tracked rigid body, which looks along x."""
    data = struct.pack("<4i", 1, 0, 0, 1) + struct.pack("<i7ffh", body, x, y, 0.0, 0.0, 0.0, 0.0, 1.0, 0.001, 1)
    return struct.pack("<HH", 7, len(data)) + data


def test_the_bridges_of_motion_capture_give_a_simulation_its_poses(tmp_path: Path, runtime: Path) -> None:
    (tmp_path / "swarm.toml").write_text(CAPTURED)
    (tmp_path / "poses.csv").write_text("".join(f"{0.1 * k:.1f},r0,1.25,0.5,0.1\n" for k in range(600)))
    run, mocap = runtime / "run", ROOT / "examples" / "mocap"
    sim = ("-m", "laptop.cli", "sim", "--config", tmp_path / "swarm.toml", "--seconds", "150", "--run-dir", run)
    robots = [run / robot for robot in ("r0", "r1")]
    places: dict[str, tuple[float, float, str]] = {}

    def heard(key: str, payload: bytes) -> None:
        pose = read(key, payload)
        assert isinstance(pose, Pose)
        places[key.split("/")[1]] = (pose.x, pose.y, pose.source)

    with contextlib.ExitStack() as stack:

        def start(*words: object) -> None:
            stack.enter_context(running([sys.executable, *map(str, words)], cwd=ROOT, stdout=subprocess.DEVNULL))

        start(*sim)
        wait_until(lambda: all((each / "bus.sock").is_socket() for each in robots), what="the buses of the simulation")
        for each in robots:
            bus = stack.enter_context(Bus.of(each))
            assert bus.wait_connected(60)
            bus.subscribe("swarm/*/dwm/pose", heard)
        start(mocap / "from_csv.py", tmp_path / "poses.csv", f"r0={robots[0] / 'bus.sock'}")
        start(mocap / "from_natnet.py", "127.0.0.1", f"7=r1:{robots[1] / 'bus.sock'}")
        stream = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))

        def placed() -> bool:
            stream.sendto(natnet_frame(7, 0.5, 1.5), ("127.0.0.1", NATNET))
            return places.keys() == {"r0", "r1"}

        wait_until(placed, what="poses of both robots")
        assert places == {"r0": (1.25, 0.5, "external"), "r1": (0.5, 1.5, "external")}
        words = ("dwm", "check", "--truth", "sim/truth", "--run-dir", str(run), "--robots", "r0", "--seconds", "3")
        check = [sys.executable, "-m", "laptop.cli", *words]
        told = subprocess.run(check, capture_output=True, text=True, check=False, timeout=240)
        assert re.search(r"r0: \d+ poses: error [\d.]+ cm rms", told.stdout + told.stderr)


def test_the_layout_for_foxglove_names_topics_that_are_served() -> None:
    from swarm.messages import type_of

    text = (ROOT / "examples" / "foxglove" / "layout.json").read_text()
    keys = set(re.findall(r"swarm/r\d/[a-z/]+", text))
    assert len(keys) >= 18
    assert all(type_of(key) is not None for key in keys)
    assert {"/scene", "/log"} <= set(re.findall(r'"(/[a-z]+)"', text))
