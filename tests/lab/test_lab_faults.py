"""Our RFCOMM links, every fault of a real kernel's sockets, and roles: inside_faults.py and inside_roles.py."""

from pathlib import Path

import pytest

from lab.inside import run_tests
from lab.vm.build import Image
from lab.vm.machine import PLAIN, Machine

pytest_plugins = ("lab_fixtures",)
pytestmark = [pytest.mark.lab, pytest.mark.timeout(1000)]


@pytest.mark.parametrize("words", ["-k 'not thousand'", "-k thousand"], ids=["each fault", "a thousand connections"])
def test_links_over_real_sockets(lab_image: Image, tmp_path: Path, words: str) -> None:
    with Machine(lab_image, tmp_path, "r0", init=PLAIN, memory_mb=1536) as robot:
        run_tests(robot, f"tests/lab/inside/inside_faults.py tests/lab/inside/inside_roles.py {words}")
