"""The lab's waiting: what is printed while it lasts, and what a failure says."""

import os
import sys
from collections.abc import Iterator

import pytest

from lab import waiting


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines are due from the first moment on."""
    monkeypatch.setattr(waiting, "FIRST_S", 0.0)
    monkeypatch.setattr(waiting, "AGAIN_S", 0.0)


@pytest.fixture
def answers() -> Iterator[bool]:
    return iter((False, False, True))


@pytest.mark.usefixtures("at_once")
def test_a_long_wait_prints_what_it_waits_for_and_what_it_saw(
    answers: Iterator[bool], capfd: pytest.CaptureFixture[str]
) -> None:
    assert waiting.until("the third answer", lambda: next(answers), state=lambda: "two links", every=0.0)
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 2
    for line in lines:
        assert line.startswith("lab: test_waiting.py::test_a_long_wait")
        assert line.endswith(": waiting since 0 s, at most 400 s: the third answer; seen last: two links")


def test_a_short_wait_prints_nothing(answers: Iterator[bool], capfd: pytest.CaptureFixture[str]) -> None:
    waiting.until("the third answer", lambda: next(answers), every=0.0)
    assert capfd.readouterr().err == ""


def test_a_wait_in_vain_names_the_condition_and_the_whole_last_state(capfd: pytest.CaptureFixture[str]) -> None:
    state = "x" * 2 * waiting.SHOWN
    text = f"the moon is here: not within 0 s; seen last: {state}"
    with pytest.raises(waiting.WaitedInVainError, match=text):
        waiting.until("the moon is here", lambda: False, 0.0, lambda: state)
    assert text in capfd.readouterr().err


def test_a_descriptor_is_waited_for_until_it_can_be_read() -> None:
    reader, writer = os.pipe()
    with pytest.raises(waiting.WaitedInVainError, match="a byte: not within 0 s"):
        waiting.readable("a byte", reader, 0.0)
    os.write(writer, b"x")
    waiting.readable("a byte", reader)
    os.close(reader)
    os.close(writer)


def test_a_command_that_fails_is_shown_with_its_output_and_one_that_hangs_is_ended() -> None:
    assert waiting.run("Python", [sys.executable, "-c", "print('yes')"]) == "yes\n"
    with pytest.raises(AssertionError, match="Python: exit code 3: no"):
        waiting.run("Python", [sys.executable, "-c", "print('no'); exit(3)"])
    with pytest.raises(waiting.WaitedInVainError, match=r"a sleep: not within 0\.1 s"):
        waiting.run("a sleep", ["sleep", "60"], 0.1)
