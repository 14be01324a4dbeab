"""`swarm pad`: a game pad's events become the keys of `swarm drive`, only while a shoulder button is held."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laptop.cli.robots.body.pad import AT_START, AXIS, BUTTON, EVENT, RELEASE, SHOULDERS, STOP, PadKeys
from swarm.onboard.body.key_velocity import DIRECTIONS, STANDSTILL, KeyVelocity

FULL = 32767


def axis(number: int, value: int) -> bytes:
    return EVENT.pack(0, value, AXIS, number)


def button(number: int, held: bool, *, at_start: bool = False) -> bytes:
    return EVENT.pack(0, held, BUTTON | (AT_START if at_start else 0), number)


@pytest.mark.parametrize(
    ("sideways", "upright", "key"),
    [(0, -FULL, "w"), (0, FULL, "s"), (-FULL, 0, "a"), (FULL, 0, "d"), (-FULL, -FULL, "q"), (FULL, -FULL, "e")],
)
@pytest.mark.parametrize("first", [0, 6])
def test_stick_and_cross_steer_while_a_shoulder_button_is_held(
    sideways: int, upright: int, key: str, first: int
) -> None:
    pad = PadKeys()
    pad.take(axis(first, sideways))
    pad.take(axis(first + 1, upright))
    assert pad.key == ""
    for shoulder in SHOULDERS:
        pad.take(button(shoulder, True))
        assert pad.key == key
        pad.take(button(shoulder, False))
        assert pad.key == ""


@given(st.lists(st.binary(min_size=EVENT.size, max_size=EVENT.size), max_size=40))
def test_whatever_a_pad_says_there_is_no_key_without_a_shoulder_button(events: list[bytes]) -> None:
    pad = PadKeys()
    for event in events:
        assert pad.take(event) in ("", STOP)
        assert pad.key in ("", *DIRECTIONS)
    for shoulder in SHOULDERS:
        pad.take(button(shoulder, False))
    assert pad.key == ""


def test_the_buttons_at_the_right_stop_all_robots_but_not_by_being_held_at_the_start() -> None:
    pad = PadKeys()
    assert pad.take(button(0, True, at_start=True)) == ""
    assert [pad.take(button(number, True)) for number in range(4)] == [STOP] * 4
    assert pad.take(button(1, False)) == ""


def test_the_release_key_ends_a_motion_at_once() -> None:
    driver = KeyVelocity()
    driver.press("w", 0.0)
    assert driver.press(RELEASE, 0.1) == STANDSTILL


def test_keys_repeat_while_they_are_held_and_end_with_the_pad(tmp_path: Path) -> None:
    device = tmp_path / "js0"
    os.mkfifo(device)
    command = [sys.executable, "-m", "laptop.cli", "pad", str(device)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        with device.open("wb", buffering=0) as pad:
            pad.write(button(4, True) + axis(1, -FULL))
            assert process.stdout.read(3) == b"www"
            pad.write(button(4, False))
            while (key := process.stdout.read(1)) == b"w":
                pass
            assert key == RELEASE.encode()
            pad.write(button(2, True))
            assert process.stdout.read(1) == STOP.encode()
        assert process.stdout.read() == b""
        assert process.wait(60) == 0


def test_a_pad_that_is_not_there_is_named(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "laptop.cli", "pad", str(tmp_path / "js7")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "js7: No such file or directory; is a game pad plugged in?" in done.stderr
