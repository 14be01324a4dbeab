"""The whole path of the thesis in one machine: the firmware in the AVR simulator behind /dev/i2c-1, a DWM1001 at its
UART, the release's services on systemd, and six robots over the kernel's RFCOMM. tests/lab/inside/inside_thesis.py has
the checks."""

import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from lab.inside import run_tests
from lab.radio.remote import address
from lab.robot import disk
from lab.shapes import LOOP, ROBOTS, TIMES
from lab.vm.build import Image
from lab.vm.machine import Machine
from swarm.config.keyfile import new_key_file

pytest_plugins = ("lab_fixtures",)
pytestmark = [pytest.mark.lab, pytest.mark.timeout(900)]

TARGET = (1.3, 0.8)
CONFIG = (
    f"""network = "lab"
[topology]
edges = {[[f"r{i}", f"r{j}"] for i, j in LOOP]}
[mesh]
links = "graph"
key = "/etc/swarm/key"
{TIMES}
[dwm]
source = "balancer"
target = "C933"
[[anchors]]
address = "D001"
x = 0.0
y = 0.0
[[anchors]]
address = "D002"
x = 2.0
y = 0.0
[[anchors]]
address = "D003"
x = 0.0
y = 2.0
[simulation]
target = [{TARGET[0]}, {TARGET[1]}]
[simulation.places]
r0 = [0.4, 0.5, 0.0]
r1 = [1.7, 0.4, 0.0]
r2 = [1.8, 1.2, 0.0]
r3 = [1.1, 1.7, 0.0]
r4 = [0.5, 1.6, 0.0]
r5 = [0.3, 1.0, 0.0]
""".replace("'", '"')
    + "".join(f'[[robots]]\nname = "r{i}"\nbluetooth = "{address(i)}"\n' for i in range(ROBOTS))
)


@pytest.fixture(scope="module")
def firmware(request: pytest.FixtureRequest) -> list[Path]:
    """The firmware, the AVR simulator, and the library of it that Debian's robots lack."""
    import firmware_build

    cache = request.config.cache
    assert cache is not None
    firmware_build.require_avr()
    folder = cache.mkdir("firmware")
    library = firmware_build.build(folder, "bench") / "libbench.so"
    needed = subprocess.run(["ldd", str(library)], capture_output=True, text=True, check=True).stdout
    simavr = next(line.split()[2] for line in needed.splitlines() if "libsimavr" in line)
    return [firmware_build.build(folder, "firmware") / "balboa.elf", library, Path(simavr)]


def test_a_robot_balances_while_it_localizes_and_two_messages_cross(
    lab_image: Image, firmware: list[Path], tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    new_key_file(tmp_path / "swarm.key", int(time.time()))
    image = disk.robots(lab_image, tmp_path, CONFIG, tmp_path / "swarm.key", firmware)
    with Machine(image, tmp_path, "r0", memory_mb=1536, niceness=disk.NICENESS) as robot:
        shutil.copy(tmp_path / "swarm.toml", robot.share / "thesis.toml")
        (robot.share / "measured").touch()
        try:
            # It lets adapters that are paired with nobody answer nobody, and udev starts it again for each adapter.
            robot.run("systemctl mask --runtime --now bluetooth")
            run_tests(robot, "-x tests/lab/inside/inside_thesis.py")
        except AssertionError:
            sys.stdout.write(robot.run("journalctl -b -u 'swarm-*' -u 'lab-*' --no-pager -n 80", code=None))
            raise
        record_property("measured", "; ".join((robot.share / "measured").read_text().splitlines()))
