"""One whole robot: booted from the installed units on real systemd and a live /dev/i2c-1, its bus broken in every way
that docs/reference/robot/i2c-bus.md knows. tests/lab/inside/inside_robot.py has the checks.
"""

import ast
import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from room import ANCHORS

from lab.inside import run_logged
from lab.robot import disk
from lab.vm import build
from lab.vm.build import Image
from lab.vm.machine import Machine
from swarm.config.keyfile import new_key_file

pytest_plugins = ("lab_fixtures",)
pytestmark = [pytest.mark.lab, pytest.mark.timeout(1100)]

INSIDE = Path(__file__).parent / "inside/inside_robot.py"

PLACE = "[simulation.places]\nr0 = [1.0, 1.0, 0.0]\n"
CONFIG = build.CONFIG.replace(build.NO_MODULE, "/run/lab/{robot}/dwm.tty") + ANCHORS + PLACE


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
    with Machine(image, folder, "r0", niceness=disk.NICENESS) as robot:
        shutil.copy(INSIDE, robot.share)
        words = f"PYTHONPATH={disk.PLACE} /opt/swarm/current/bin/python /share/inside_robot.py"
        run_logged(robot, "the checks of inside_robot.py", words, 700)
        lines = [json.loads(line) for line in (robot.share / "report").read_text().splitlines()]
    return {line["check"]: line for line in lines}


@pytest.mark.parametrize("check", checks())
def test_on_a_live_bus(report: Report, check: str, record_property: Callable[[str, object], None]) -> None:
    assert check in report, f"not tried: {[*report][-1]} has failed"
    found = report[check]
    measured = {name: value for name, value in found.items() if name not in ("check", "problem")}
    if measured:
        record_property("measured", ", ".join(f"{name} {value:.3g}" for name, value in measured.items()))
    if found["problem"]:
        pytest.fail(str(found["problem"]))  # whole: an assertion would leave out what the journal says
