"""LEDs, buttons, battery, buzzer, stack, reset causes, bootloader, sleep."""

import itertools
import subprocess

import pytest
from avr_bench import BROWN_OUT, HZ, POWER_ON, RESET_PIN, WATCHDOG
from firmware_layout import CONSTANTS, RESET_CAUSE

pytest_plugins = ("firmware_fixtures",)

COLD, WARM = 0, RESET_CAUSE["WARM"]
BOOTLOADER = 0x7000


@pytest.mark.parametrize("leds", list(itertools.product((False, True), repeat=3)))
def test_the_firmware_shows_the_leds_that_are_written(bench, leds):
    bench.put("LEDS", bytes(leds))
    bench.run(0.003)
    assert bench.leds() == leds
    assert bench.get("LEDS") == bytes(leds)


def test_leds_are_dark_after_power_on(bench):
    assert bench.leds() == (False, False, False)


@pytest.mark.parametrize("pressed", list(itertools.product((False, True), repeat=3)))
@pytest.mark.parametrize("lit", [False, True])
def test_buttons_are_read_whether_their_leds_are_lit_or_not(bench, pressed, lit):
    bench.put("LEDS", bytes((lit, lit, lit)))
    a, b, c = pressed
    bench.press(a=a, b=b, c=c)
    bench.run(0.03)
    assert bench.number("BUTTONS") == a | b << 1 | c << 2
    assert bench.leds() == (lit, lit, lit), "reading leaves them as they were"
    bench.press()
    bench.run(0.03)
    assert bench.number("BUTTONS") == 0


def test_a_bouncing_contact_is_one_press(bench):
    bench.run(0.0013)
    seen = []
    for step in range(120):
        down = step >= 30 and (step > 40 or step % 2 == 0)
        bench.press(a=down, b=down, c=down)
        bench.run(0.0005)
        seen.append(bench.number("BUTTONS"))
    assert [value for value, _ in itertools.groupby(seen)] == [0, 7]


def test_a_lit_led_goes_dark_for_microseconds_only(bench):
    """Reading a button borrows its LED's pin."""
    bench.put("LEDS", b"\1\1\1")
    bench.run(0.005)
    bench.call("watch", 1)  # instruction by instruction
    dark = samples = 0
    for _ in range(4000):
        bench.run(2e-6)
        samples += 1
        dark += bench.leds() != (True, True, True)
    assert dark < samples * 0.003


@pytest.mark.parametrize("volts", [4.8, 6.0, 7.4, 9.6, 14.9])
def test_the_firmware_measures_the_battery_to_15_millivolts(bench, volts):
    bench.battery(volts)
    bench.run(1.0)
    assert bench.number("BATTERY") == pytest.approx(1000 * volts, abs=15)


def test_the_battery_is_known_soon_and_smoothed(new_bench):
    bench = new_bench()
    bench.battery(7.4)
    bench.run(0.025)
    assert bench.number("BATTERY") == pytest.approx(7400, abs=15), "the first sample counts whole"
    bench.battery(6.0)
    bench.run(0.02)
    assert bench.number("BATTERY") > 7000
    bench.run(1.0)
    assert bench.number("BATTERY") == pytest.approx(6000, abs=15)


# Buzzer


def sounding(bench, seconds, step=0.001):
    """Frequencies and how long each sounds, ms."""
    heard = []
    for _ in range(round(seconds / step)):
        heard.append(round(bench.call("tone_hz")))
        bench.run(step)
    return [(hz, len(list(group))) for hz, group in itertools.groupby(heard)]


def test_a_tune_is_played_while_everything_goes_on(bench):
    bench.put("NOTES", bytes((15, 69, 5, 0, 2, 81, 3)))
    bench.run(0.0011)
    assert bench.number("NOTES_LEFT") == 3
    assert bench.call("tone_duty") == pytest.approx(0.5, abs=0.01)
    heard = [(hz, ms) for hz, ms in sounding(bench, 0.12) if ms > 1]
    assert [hz for hz, _ in heard] == [pytest.approx(440, abs=1), 0, pytest.approx(880, abs=2), 0]
    assert [ms for _, ms in heard[1:3]] == [pytest.approx(20, abs=1), pytest.approx(30, abs=1)]
    assert bench.number("NOTES_LEFT") == 0


def test_a_tune_can_be_ended(bench):
    bench.put("NOTES", bytes((15, 69, 255)))
    bench.run(0.01)
    assert bench.call("tone_hz") > 400
    bench.put("NOTES", b"\0")
    bench.run(0.003)
    assert bench.call("tone_hz") == 0
    assert bench.number("NOTES_LEFT") == 0


def test_volume_0_is_silence(bench):
    bench.put("NOTES", bytes((0, 69, 20)))
    assert sounding(bench, 0.05) == [(0, 50)]
    assert bench.number("NOTES_LEFT") == 1


def test_half_a_note_is_refused(bench):
    bench.put("NOTES", bytes((15, 69)))
    assert bench.number("REFUSED") == 1
    assert sounding(bench, 0.01) == [(0, 10)]


# Beginnings


@pytest.mark.parametrize("flags", [POWER_ON, RESET_PIN, BROWN_OUT, WATCHDOG, POWER_ON | BROWN_OUT])
def test_the_cause_of_the_reset_is_told(new_bench, flags):
    bench = new_bench(mcusr=flags)
    bench.run(0.02)
    assert bench.number("RESET_CAUSE") == flags, "RAM had no history"
    bench.run(1.0)
    assert bench.call("resets") == 0


@pytest.mark.parametrize("flags", [RESET_PIN, BROWN_OUT, WATCHDOG, 0])
def test_a_reset_with_the_power_on_is_told_from_power_on(bench, flags):
    bench.call("reset", flags)
    bench.run(0.02)
    assert bench.number("RESET_CAUSE") == flags | WARM


def test_power_on_is_power_on_whatever_ram_says(bench):
    bench.call("reset", POWER_ON)
    bench.run(0.02)
    assert bench.number("RESET_CAUSE") == POWER_ON


@pytest.fixture
def caterina(built):
    """Makes the bench start in the stand-in of Pololu's bootloader at each reset, as the BOOTRST fuse does."""
    words = memoryview((built / "caterina.bin").read_bytes()).cast("H")

    def install(bench):
        for i, word in enumerate(words):
            bench.call("set_flash", BOOTLOADER + 2 * i, word)
        bench.call("boot_at", BOOTLOADER)
        return bench

    return install


@pytest.mark.parametrize(
    ("flags", "cause"),
    [(POWER_ON | BROWN_OUT, COLD), (BROWN_OUT, BROWN_OUT), (0, COLD)],
    ids=["power-on", "brown-out", "none"],
)
def test_through_the_bootloader_brown_out_is_still_told(new_bench, caterina, flags, cause):
    """It clears the flags of power-on, pin and watchdog."""
    bench = caterina(new_bench())
    for address in range(0x100, 0xB00):
        bench.call("poke", address, 0x3C)  # no history
    bench.call("reset", flags)
    bench.run(0.02)
    assert bench.number("RESET_CAUSE") == cause


@pytest.mark.parametrize("flags", [RESET_PIN, WATCHDOG])
def test_through_the_bootloader_a_warm_reset_is_still_told(bench, caterina, flags):
    caterina(bench).call("reset", flags)
    bench.run(0.02)
    assert bench.number("RESET_CAUSE") == WARM


def test_the_bootloader_command_ends_in_the_bootloader_with_the_motors_off(bench, caterina):
    caterina(bench)
    bench.drive(300, -300)
    bench.put("COMMAND", CONSTANTS["BOOTLOADER_COMMAND"].to_bytes(2, "little"))
    bench.run(0.003)
    assert bench.motors() == (0.0, 0.0)
    start = bench.now
    bench.run_until(lambda: bench.call("resets") == 1, 0.05, 1e-4)
    assert bench.now - start < 0.05
    assert bench.call("reset_flags") & WATCHDOG
    bench.run(0.5)
    assert bench.call("pc") >= BOOTLOADER
    assert bench.call("data", 24) == 0xB0, "it found its key and stays"
    assert bench.call("resets") == 1
    assert bench.call("pin_out", b"B", 5) == -1
    assert bench.call("pin_out", b"B", 6) == -1, "motor pins are inputs: the drivers' pull-downs hold them"


def test_an_accidental_watchdog_reset_does_not_stay_in_the_bootloader(bench, caterina):
    caterina(bench).call("reset", WATCHDOG)
    bench.run(0.02)
    assert bench.number("VERSION") == CONSTANTS["LAYOUT_VERSION"]


@pytest.mark.parametrize("command", [0, 0x07B0, 0xB006, 0xFFFF])
def test_no_other_command_does_it(bench, command):
    bench.put("COMMAND", command.to_bytes(2, "little"))
    bench.run(0.5)
    assert bench.call("resets") == 0
    assert bench.number("REFUSED") == 1


# Resources


def test_the_stack_has_room_and_says_how_much(bench):
    bench.wheels(5000, 5000)
    for step in range(40):
        bench.drive(step, step)
        bench.put("NOTES", bytes((15, 60, 1)))
        bench.get_at(32, 32)
        bench.run(0.01)
        if bench.sent():
            bench.feed(bytes.fromhex("400100410d") + bytes(12) + b"\x64" + b"\x49\x01\x00")
    free = bench.number("FREE_STACK")
    assert 900 < free < 1792


def test_the_stack_figure_is_the_deepest_ever(bench):
    bench.run(0.2)
    free = bench.number("FREE_STACK")
    bench.call("poke", 0x0AFF - 500, 0)  # as a deeper call would have left it
    bench.run(0.2)
    lower = bench.number("FREE_STACK")
    assert lower < free
    assert 0x0AFF - 500 - lower < 0x0800, "variables end below the bootloader's key"


def test_the_firmware_sleeps_when_there_is_nothing_to_do(bench):
    bench.run(0.1)
    awake = samples = 0
    for _ in range(3000):
        bench.run(3.3e-6)
        samples += 1
        awake += not bench.call("asleep")
    assert awake < 0.15 * samples


def test_more_than_65_seconds_change_nothing(new_bench):
    """16 bits of milliseconds wrap after 65 s, which a sleeping chip simulates in one."""
    bench = new_bench()
    bench.run(70.0)
    assert bench.call("resets") == 0
    bench.drive(100, 100)
    bench.run(0.19)
    assert bench.motors() == (0.25, 0.25)
    bench.run(0.02)
    assert bench.motors() == (0.0, 0.0)
    assert bench.cycles > 70 * HZ


def test_the_wrap_of_the_clock_after_49_days_changes_nothing(bench, built):
    """32 bits of milliseconds: the tune, the questions to the module and the motors' time go on through it."""
    listed = subprocess.run(["avr-nm", "-C", built / "balboa.elf"], capture_output=True, text=True, check=True).stdout
    (address,) = (int(line[:8], 16) & 0xFFFF for line in listed.splitlines() if line.endswith("::milliseconds"))
    for at, byte in enumerate((2**32 - 300).to_bytes(4, "little")):
        bench.call("poke", address + at, byte)
    bench.run(0.2)
    bench.sent()
    bench.put("NOTES", bytes((15, 69, 30)))
    bench.drive(100, 100)
    start = bench.now
    stopped = bench.run_until(lambda: bench.motors() == (0.0, 0.0), 0.21, 1e-4)
    assert stopped - start == pytest.approx(0.2, abs=1.5e-3)
    assert bench.call("data", address + 3) == 0, "it has wrapped"
    bench.run(0.8)
    assert len(bench.sent()) in (18, 20, 22), "a question of two bytes every 100 ms"
    assert bench.number("NOTES_LEFT") == 0
    assert bench.call("resets") == 0
