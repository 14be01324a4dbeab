"""How a command ends, whatever ends it."""

import signal

import pytest
from conftest import Processes, pytest_runtest_protocol

WAITS = """
import threading
from swarm.onboard.command_line import end_with

class Lock:
    held = interrupts = False

    def acquire(self, *_):
        if self.interrupts:
            raise KeyboardInterrupt
        self.held = self.interrupts = True
        return True

    def release(self):
        if not self.held:
            raise RuntimeError("release unlocked lock")
        self.held = False

    def _is_owned(self):
        return self.held

    def __enter__(self):
        self.acquire()

    def __exit__(self, *_):
        self.release()

def run():
    condition = threading.Condition(Lock())
    with condition:
        condition.wait(0.001)

end_with("test", run)
"""

DEFECT = """
from swarm.onboard.command_line import end_with

def run():
    raise RuntimeError("release unlocked lock")

end_with("test", run)
"""


def ended(processes: Processes, code: str) -> tuple[int, str]:
    process = processes.start("-c", code)
    _, errors = process.communicate(timeout=60)
    return process.returncode, errors


def test_ctrl_c_while_a_condition_takes_its_lock_back_is_ctrl_c(processes: Processes) -> None:
    assert ended(processes, WAITS) == (130, "")


def test_the_same_error_without_ctrl_c_is_a_defect(processes: Processes) -> None:
    code, errors = ended(processes, DEFECT)
    assert code == 1
    assert "Traceback" in errors


def test_a_command_that_was_interrupted_in_a_test_keeps_no_later_test_from_ctrl_c(
    request: pytest.FixtureRequest,
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    next(pytest_runtest_protocol(request.node))
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
