"""Driving by keyboard: a robot moves only while keys come, under virtual time; and the keys of a terminal."""

from hypothesis import given
from hypothesis import strategies as st

from swarm.onboard.body.key_velocity import (
    DIRECTIONS,
    FIRST_S,
    REPEAT_S,
    SPEED,
    STANDSTILL,
    TURN_RATE,
    KeyVelocity,
    Velocity,
)
from swarm.onboard.body.keyboard import split


def test_a_first_press_holds_until_keyboards_repeat_and_a_repeat_for_a_moment() -> None:
    driver = KeyVelocity()
    assert driver.press("w", 0.0) == Velocity(SPEED, 0.0, FIRST_S)
    assert driver.handle_timer(0.69) is None
    assert driver.press("w", 0.66) == Velocity(SPEED, 0.0, REPEAT_S)
    assert driver.deadline == 0.66 + REPEAT_S
    assert driver.handle_timer(0.87) == STANDSTILL
    assert driver.deadline is None


def test_keys_drive_curves_backward_and_at_other_speeds() -> None:
    driver = KeyVelocity()
    assert driver.press("+", 0.0) is None
    assert driver.press("e", 0.0) == Velocity(1.5 * SPEED, -1.5 * TURN_RATE, FIRST_S)
    assert driver.press("-", 0.1) == STANDSTILL  # another key: the first one was let go
    assert driver.press("down", 0.2) == Velocity(-SPEED, 0.0, FIRST_S)


PRESSES = st.lists(st.tuples(st.sampled_from([*DIRECTIONS, "+", "-", "z", "enter"]), st.floats(0.0, 2.0)), max_size=30)


@given(PRESSES)
def test_no_command_outlives_the_last_key_by_more_than_the_first_press_holds(presses: list[tuple[str, float]]) -> None:
    """Whatever is pressed when, what is in force ends in time, and with each key the robot obeys that key alone."""
    driver, now, until, pressed = KeyVelocity(), 0.0, float("-inf"), float("-inf")
    for key, pause in presses:
        if driver.deadline is not None and driver.deadline <= now + pause:
            assert driver.handle_timer(driver.deadline) == STANDSTILL
        now += pause
        velocity = driver.press(key, now)
        if velocity is not None:
            until = now + velocity.seconds
        if key in DIRECTIONS:
            pressed = now
            assert velocity is not None
            assert (velocity.speed != 0.0, velocity.turn_rate != 0.0) == tuple(map(bool, DIRECTIONS[key]))
        else:
            assert driver.deadline is None
        assert until <= max(pressed + FIRST_S, now + REPEAT_S)
    if driver.deadline is not None:
        assert driver.deadline <= now + FIRST_S
        assert driver.handle_timer(driver.deadline) == STANDSTILL


def test_arrows_letters_and_foreign_keys_of_a_terminal_are_told_apart() -> None:
    assert split(b"\x1b[Aw \x1bOD\x1b[3~\x1b[1;5Cx\r\xc3\xa4") == ["up", "w", " ", "left", "x", "enter"]
    assert split(b"\x1b") == ["escape"]


@given(st.binary(max_size=80))
def test_any_bytes_of_a_terminal_are_keys_or_nothing(data: bytes) -> None:
    assert all(key in {"up", "down", "left", "right", "escape", "enter"} or len(key) == 1 for key in split(data))
