"""Motors: what the drivers get, and everything that turns them off."""

import contextlib
import struct

import pytest
from avr_bench import POWER_ON
from firmware_layout import CONSTANTS, FIELDS, RESET_CAUSE

pytest_plugins = ("firmware_fixtures",)

TOP = CONSTANTS["MOTOR_TOP"]
STOPPED = CONSTANTS["STOPPED_BY_WATCHDOG"]


def test_motors_are_off_after_power_on(new_bench):
    bench = new_bench()
    for _ in range(300):
        bench.run(1e-4)
        assert bench.motors() == (0.0, 0.0)


def test_pwm_is_20_khz(bench):
    bench.drive(1, 1)
    assert bench.call("pwm_hz") == 20e3


@pytest.mark.parametrize(
    ("command", "duty"),
    [
        ((0, 0), (0.0, 0.0)),
        ((100, -100), (0.25, -0.25)),
        ((-300, 300), (-0.75, 0.75)),
        ((TOP, -TOP), (1.0, -1.0)),
        ((401, -401), (1.0, -1.0)),
        ((32767, -32768), (1.0, -1.0)),
        ((1, -1), (1 / TOP, -1 / TOP)),
    ],
)
def test_motors_get_the_commanded_duty_and_direction(bench, command, duty):
    bench.drive(*command)
    assert bench.motors() == duty
    left, right = struct.unpack("<2h", bench.get("MOTORS"))
    assert (left / TOP, right / TOP) == duty, "what is in force can be read"


def test_a_new_command_acts_at_its_stop(bench):
    """In the interrupt, whatever the main loop does: within the 100 us that the Pi waits anyway."""
    for duty in range(-400, 401, 80):
        bench.drive(duty, -duty)
        assert bench.motors() == (duty / TOP, -duty / TOP)


@pytest.mark.parametrize("phase", range(7))
def test_the_watchdog_stops_them_after_200_ms_to_the_millisecond(bench, phase):
    bench.run(phase * 0.00017)
    bench.drive(200, -200)
    start = bench.now
    bench.run(0.1996)
    assert bench.motors() == (0.5, -0.5)
    stopped = bench.run_until(lambda: bench.motors() == (0.0, 0.0), 0.01, 1e-5)
    assert 0.1998 <= stopped - start <= 0.201, "counted from the end of the pause after the write"
    assert bench.number("STATUS") & STOPPED
    assert bench.get("MOTORS") == bytes(4)


def test_each_write_gives_another_200_ms(bench):
    for _ in range(8):
        bench.drive(100, 100)
        bench.run(0.19)
        assert bench.motors() == (0.25, 0.25)
    bench.run(0.02)
    assert bench.motors() == (0.0, 0.0)
    bench.drive(100, 100)
    assert bench.motors() == (0.25, 0.25)
    assert not bench.number("STATUS") & STOPPED, "a new command clears it"


def test_reads_and_leds_do_not_feed_the_watchdog(bench):
    bench.drive(100, 100)
    start = bench.now
    while bench.motors() != (0.0, 0.0):
        bench.put("LEDS", b"\1\1\1")
        bench.get("ENCODERS")
        bench.run(0.005)
        assert bench.now < start + 0.25


@pytest.mark.parametrize("index", range(8))
def test_a_motor_write_that_was_cut_off_or_got_another_index_changes_and_feeds_nothing(bench, index):
    """A duty of -1 and one of 10 have no byte in common: a mixture of them is more than half power."""
    bench.drive(-1, -1)
    start, refused = bench.now, bench.number("REFUSED")
    sent = struct.pack("<2h", 10, 10)
    writes = [sent[:size] for size in (1, 2, 3, 4) if index + size > FIELDS["MOTORS"].offset]
    if index == FIELDS["MOTORS"].offset:
        writes.remove(sent)
    for data in writes:
        with contextlib.suppress(OSError):
            bench.write(CONSTANTS["ADDRESS"], bytes((index,)) + data)
        bench.run(1e-4)
        assert bench.get("MOTORS") == struct.pack("<2h", -1, -1), data
    assert bench.number("REFUSED") == refused + len(writes)
    bench.run_to(start + 0.202)
    assert bench.motors() == (0.0, 0.0)


def test_motors_at_rest_are_not_reported_as_stopped(bench):
    bench.drive(0, 0)
    bench.run(0.5)
    assert not bench.number("STATUS") & STOPPED


def hang(bench, *instructions):
    """Replace the program where the main loop is by `instructions`, and return what was there."""
    place = bench.call("to_main")
    assert place > 0
    before = [bench.call("flash", place + 2 * i) for i in range(len(instructions))]
    for i, instruction in enumerate(instructions):
        bench.call("set_flash", place + 2 * i, instruction)
    return place, before


def mend(bench, place, before):
    for i, instruction in enumerate(before):
        bench.call("set_flash", place + 2 * i, instruction)


RJMP_SELF, RJMP_BACK, CLI = 0xCFFF, 0xCFFE, 0x94F8


def test_a_main_loop_that_stands_still_stops_the_motors_and_is_reset(bench):
    bench.run(0.05)
    bench.drive(200, 200)
    start = bench.now
    mended = hang(bench, RJMP_SELF)
    # The Pi goes on commanding, since interrupts still answer it: that must not keep the motors running for long.
    off = bench.run_until(lambda: bench.motors() == (0.0, 0.0), 0.12)
    assert 0.098 <= off - start <= 0.104
    bench.run_until(lambda: bench.call("resets") == 1, 0.3)
    assert bench.call("reset_at") / 16e6 - start < 0.3
    mend(bench, *mended)
    assert bench.motors() == (0.0, 0.0)
    bench.run(0.02)
    cause = bench.number("RESET_CAUSE")
    assert cause == RESET_CAUSE["WATCHDOG"] | RESET_CAUSE["WARM"] | RESET_CAUSE["HUNG"]
    bench.run(1.0)
    assert bench.call("resets") == 1


def test_a_main_loop_that_goes_on_after_its_motors_were_locked_is_reset_too(bench):
    """Its watchdog alone would be content, and the motors locked for as long as the power is on."""
    bench.run(0.05)
    mended = hang(bench, RJMP_SELF)
    bench.run(0.15)
    mend(bench, *mended)
    bench.run_until(lambda: bench.call("resets") == 1, 0.15)
    bench.run(0.02)
    assert bench.number("RESET_CAUSE") == RESET_CAUSE["WATCHDOG"] | RESET_CAUSE["WARM"] | RESET_CAUSE["HUNG"]
    bench.drive(200, 200)
    assert bench.motors() == (0.5, 0.5)
    bench.run(1.0)
    assert bench.call("resets") == 1


def test_while_the_main_loop_hangs_no_command_brings_the_motors_back(bench):
    bench.run(0.05)
    hang(bench, RJMP_SELF)
    bench.run(0.11)
    bench.drive(300, 300)
    assert bench.motors() == (0.0, 0.0)


def test_a_program_stuck_with_interrupts_off_is_reset(bench):
    bench.run(0.05)
    bench.drive(200, 200)
    mended = hang(bench, CLI, RJMP_BACK)
    bench.run_until(lambda: bench.call("resets") == 1, 0.3)
    assert bench.motors() == (0.0, 0.0)
    mend(bench, *mended)
    bench.run(0.02)
    assert bench.number("RESET_CAUSE") == RESET_CAUSE["WATCHDOG"] | RESET_CAUSE["WARM"]


ENABLE_TIMER_0_COMPARE_B = 0xE086, 0x9380, 0x006E
"""ldi r24, 6; sts TIMSK0, r24: an interrupt that the firmware does not serve, within a millisecond."""


def test_an_unexpected_interrupt_stops_them_and_resets_the_chip(bench):
    bench.run(0.05)
    bench.drive(200, 200)
    start = bench.now
    mended = hang(bench, *ENABLE_TIMER_0_COMPARE_B, RJMP_SELF)
    off = bench.run_until(lambda: bench.motors() == (0.0, 0.0), 0.01)
    assert off - start < 0.005
    bench.run_until(lambda: bench.call("resets") == 1, 0.3)
    mend(bench, *mended)
    bench.run(0.02)
    assert bench.number("RESET_CAUSE") == RESET_CAUSE["WATCHDOG"] | RESET_CAUSE["WARM"]


def test_a_reset_stops_them(bench):
    bench.drive(300, 300)
    bench.call("reset", POWER_ON)
    assert bench.motors() == (0.0, 0.0)
    bench.run(0.02)
    assert bench.motors() == (0.0, 0.0)
    assert bench.get_at(FIELDS["LEDS"].offset, 7) == bytes(7)
