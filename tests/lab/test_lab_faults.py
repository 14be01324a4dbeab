"""Our RFCOMM links and every fault of a real kernel's sockets: tests/lab/inside_faults.py, in one machine."""

from collections.abc import Callable

import pytest

from lab.inside import run_tests
from lab.vm.machine import PLAIN, Machine

pytest_plugins = ("lab_fixtures",)
pytestmark = [pytest.mark.lab, pytest.mark.timeout(1000)]


@pytest.mark.parametrize("words", ["-k 'not thousand'", "-k thousand"], ids=["each fault", "a thousand connections"])
def test_links_over_real_sockets(machine: Callable[..., Machine], words: str) -> None:
    robot = machine("r0", init=PLAIN, alone=True)
    robot.start()
    run_tests(robot, f"tests/lab/inside_faults.py {words}", 500)
