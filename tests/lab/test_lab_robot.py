"""One whole robot: booted from the installed units on real systemd and a live /dev/i2c-1, its bus broken in every way
that docs/devices.md knows. tests/lab/inside_robot.py has the checks.

The machine's clock is that of its instructions, so that a busy host makes it slow but never late.
"""

import ast
import json
import shutil
import sys
import time
from pathlib import Path

import pytest

from lab.robot import disk
from lab.vm.build import Image
from lab.vm.machine import Machine
from swarm.keyfile import new_key_file

pytest_plugins = ("lab_fixtures",)
pytestmark = [pytest.mark.lab, pytest.mark.timeout(600)]

HERE = Path(__file__).parent
INSIDE = HERE / "inside_robot.py"

CONFIG = """network = "lab"
[topology]
edges = []
[[robots]]
name = "r0"
link = "tcp:127.0.0.1:5501"
[mesh]
listen = "127.0.0.1:5501"
[dwm]
source = "serial:/run/lab/{robot}/dwm.tty"
[[anchors]]
address = "C933"
x = 0.0
y = 0.0
z = 0.0
[[anchors]]
address = "C584"
x = 3.0
y = 0.0
z = 0.0
[[anchors]]
address = "D32F"
x = 0.0
y = 3.0
z = 0.0
[[anchors]]
address = "0C1D"
x = 3.0
y = 3.0
z = 0.0
[simulation.places]
r0 = [1.0, 1.0, 0.0]
"""


def checks() -> list[str]:
    """Their names, read from the file: it runs only inside."""
    tree = ast.parse(INSIDE.read_text())
    (table,) = [
        each.value
        for each in tree.body
        if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name) and each.target.id == "CHECKS"
    ]
    assert isinstance(table, ast.Dict)
    return [ast.literal_eval(key) for key in table.keys if key is not None]


Report = dict[str, dict[str, object]]


@pytest.fixture(scope="module")
def report(lab_image: Image, tmp_path_factory: pytest.TempPathFactory) -> Report:
    """Boot it, and run all checks inside."""
    folder = tmp_path_factory.mktemp("robot")
    new_key_file(folder / "swarm.key", int(time.time()))
    image = disk.robots(lab_image, folder, CONFIG, folder / "swarm.key")
    with Machine(image, folder, "r0", steady=True) as robot:
        shutil.copy(INSIDE, robot.share)
        robot.run(f"PYTHONPATH={disk.PLACE} /opt/swarm/current/bin/python /share/inside_robot.py", 400)
        lines = [json.loads(line) for line in (robot.share / "report").read_text().splitlines()]
    return {line["check"]: line for line in lines}


@pytest.mark.parametrize("check", checks())
def test_on_a_live_bus(report: Report, check: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert check in report, f"not tried: {[*report][-1]} has failed"
    found = report[check]
    measured = {name: value for name, value in found.items() if name not in ("check", "problem")}
    with capsys.disabled():
        sys.stdout.write(f"\n{check}: {', '.join(f'{name} {value:.3g}' for name, value in measured.items())}")
    assert found["problem"] == ""
