"""One machine for each robot, in line: each has a kernel, an adapter and a clock of its own; the air is on the host."""

import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from lab.inside import command, furnish
from lab.radio.remote import Radio
from lab.shapes import ITERATIONS, line
from lab.vm.build import Image
from lab.vm.machine import PLAIN, Machine
from swarm.keyfile import new_key_file
from swarm.recording.run import Run

pytest_plugins = ("lab_fixtures",)
pytestmark = [pytest.mark.lab, pytest.mark.timeout(600)]


@pytest.mark.parametrize("count", [3, 6])
def test_robots_in_machines_of_their_own_compute_what_the_simulation_computes(
    lab_image: Image, tmp_path: Path, count: int
) -> None:
    new_key_file(tmp_path / "swarm.key", int(time.time()))
    (tmp_path / "swarm.toml").write_text(line(count, 'key = "/share/swarm.key"'))
    (tmp_path / "own.toml").write_text(line(count, "insecure = true"))
    words = ["consensus", "--config", str(tmp_path / "own.toml"), "--virtual", "--iterations", str(ITERATIONS)]
    record = ["--json", "--record", str(tmp_path / "simulated")]
    subprocess.run([sys.executable, "-m", "services.sim", *words, *record], check=True, capture_output=True)
    with Radio(tmp_path, count, machines=True) as radio:
        edges = [[radio.addresses[i], radio.addresses[i + 1]] for i in range(count - 1)]
        robots = [
            Machine(lab_image, tmp_path / f"r{i}", f"r{i}", init=PLAIN, memory_mb=320, radio=tmp_path / f"radio-{i}")
            for i in range(count)
        ]

        def compute(robot: Machine) -> int:
            robot.wait_booted()
            furnish(robot)
            for name in ("swarm.key", "swarm.toml"):
                shutil.copy(tmp_path / name, robot.share)
            words = command(f"tests/lab/inside_robot_mesh.py {robot.name} {ITERATIONS}")
            number = robot.spawn(f"touch /tmp/go-on; {words} >/share/said 2>&1", 500)
            robot.run("until grep -q reached /share/said; do sleep 0.5; [ -e /tmp/go-on ]; done", 400)
            return number

        try:
            for robot in robots:
                robot.switch_on()
            with ThreadPoolExecutor(count) as pool:
                numbers = list(pool.map(compute, robots))
            heard = radio.order("look")["links"]
            for robot in robots:
                robot.run("rm /tmp/go-on")
            for robot, number in zip(robots, numbers, strict=True):
                assert robot.wait(number, 120).code == 0, (robot.share / "said").read_text()
        finally:
            for robot in robots:
                robot.kill()
    assert heard == edges
    simulated = Run(tmp_path / "simulated").trajectories("consensus")
    for robot in robots:
        rows = Run(robot.share / "records").trajectories("consensus")[robot.name].rows
        for k in range(ITERATIONS + 1):
            assert rows[k] == simulated[robot.name].rows[k], f"{robot.name}, iteration {k}"
