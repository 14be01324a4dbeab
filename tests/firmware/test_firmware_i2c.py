"""The I2C slave of the real firmware: protocol, coherence, refusal, timing."""

import errno
import itertools
import struct

import pytest
from firmware_layout import CONSTANTS, FIELDS

from services.balancer.device_drivers import Balboa

pytest_plugins = ("firmware_fixtures",)

ADDRESS = CONSTANTS["ADDRESS"]
LIMIT = 50e-6
"""No stretch of SCL and no time with interrupts off may be longer."""


def refused(action, number=errno.EREMOTEIO):
    with pytest.raises(OSError) as caught:  # noqa: PT011
        action()
    return caught.value.errno == number


def test_the_firmware_says_its_version_and_revision(bench):
    assert bench.get("VERSION") == bytes((CONSTANTS["LAYOUT_VERSION"],))
    assert bench.get("REVISION") == bytes((CONSTANTS["REVISION_NUMBER"],))


@pytest.mark.parametrize("address", [0, 19, 21, 0x6B])
def test_the_firmware_answers_at_its_own_address_only(bench, address):
    assert refused(lambda: bench.write(address, b"\0"))
    assert refused(lambda: bench.read(address, 1))


def test_reads_go_on_from_the_index_in_one_transfer_or_in_several(bench):
    bench.put("LEDS", b"\1\0\1")
    bench.write(ADDRESS, b"\0")
    bench.run(1e-4)
    assert bench.read(ADDRESS, 4) == bytes((CONSTANTS["LAYOUT_VERSION"], 1, 0, 1))
    bench.write(ADDRESS, b"\0")
    singles = b""
    for _ in range(4):
        bench.run(1e-4)
        singles += bench.read(ADDRESS, 1)
    assert singles == bytes((CONSTANTS["LAYOUT_VERSION"], 1, 0, 1))


def test_a_repeated_start_does_as_well_as_a_stop(bench):
    bench.put("LEDS", b"\1\1\0")
    assert bench.write_read(ADDRESS, bytes((FIELDS["LEDS"].offset,)), 3) == b"\1\1\0"


def test_a_write_leaves_the_index_where_it_was(bench):
    bench.put("LEDS", b"\1\0\1")
    assert bench.read(ADDRESS, 3) == b"\0\0\0", "frozen when the index came, before the write was applied"
    assert bench.get("LEDS") == b"\1\0\1"


def test_beyond_the_end_there_are_zeros(bench):
    assert bench.get_at(250, 32) == bytes(32)
    assert bench.get_at(255, 4) == bytes(4)


def test_nothing_is_applied_before_stop(bench):
    data = bytes((FIELDS["MOTORS"].offset,)) + struct.pack("<2h", 100, 100)
    assert bench.call("i2c_write", ADDRESS, data, len(data), 0) == len(data)
    bench.run(0.005)
    assert bench.motors() == (0.0, 0.0)
    bench.read(ADDRESS, 1)  # the repeated START
    assert bench.motors() == (0.25, 0.25)


@pytest.mark.parametrize(
    ("index", "data"),
    [
        (0, b"\1"),  # read-only
        (1, b"\1\1\1\x64\0\x64\0\0"),  # into the encoders
        (4, struct.pack("<3h", 100, 100, 100)),
        (7, b"\0\0"),
        (8, b"\0"),
        (31, b"\0"),
        (32, bytes(100)),
        (145, b"\0"),
        (160, bytes(32)),
        (191, b"\0"),
        (222, b"\0\0"),
        (223, b"\0"),
        (255, b"\0" * 40),
    ],
)
def test_a_write_that_does_not_fit_is_refused_whole(bench, index, data):
    before = bench.get_at(0, 32)
    assert refused(lambda: bench.write(ADDRESS, bytes((index,)) + data))
    bench.run(0.002)
    after = bench.get_at(0, 32)
    offset = FIELDS["REFUSED"].offset
    assert after[:offset] == before[:offset]
    assert after[offset] == before[offset] + 1
    assert bench.motors() == (0.0, 0.0)
    bench.put("LEDS", b"\1\1\1")
    assert bench.get("LEDS") == b"\1\1\1", "the next write is heard"


def test_counters_read_in_one_piece_belong_to_one_moment(bench):
    """Both wheels turn alike, across the carry from the low to the high byte: torn bytes would be 256 off."""
    bench.wheels(9000, 9000)
    seen = []
    for _ in range(150):
        low_high = bench.get("ENCODERS", gap=1.3e-4)
        left, right = struct.unpack("<2h", low_high)
        true = bench.counts()[0]
        assert abs(left - right) <= 1
        assert 0 <= true - left < 12, "what was read is what was there when the index came"
        seen.append(left)
    assert seen[-1] > 512, "many carries were seen"
    assert seen == sorted(seen)


def test_slow_single_reads_after_one_index_are_of_one_moment_too(bench):
    bench.wheels(9000, -9000)
    for _ in range(40):
        bench.write(ADDRESS, bytes((FIELDS["ENCODERS"].offset,)))
        at_index = bench.counts()
        data = b""
        for _ in range(4):
            bench.run(7e-4)
            data += bench.read(ADDRESS, 1)
        bench.run(1e-4)
        left, right = struct.unpack("<2h", data)
        assert abs(left - at_index[0]) <= 1
        assert abs(right - at_index[1]) <= 1


def busy_second(bench, seconds):
    """A robot at work: encoders, UWB, LEDs, notes, and a master that never leaves it alone for longer than it must."""
    uwb = bytes.fromhex("400100410d") + bytes(12) + b"\x64" + b"\x49\x51\x04" + (bytes(6) + b"\x32" + bytes(13)) * 4
    bench.wheels(7300, -6900)
    end = bench.now + seconds
    for step in itertools.count():
        if bench.now >= end:
            return
        bench.get("ENCODERS")
        bench.drive(step % 400, -(step % 300))
        bench.put("LEDS", bytes((step & 1, step & 2, step & 4)))
        bench.get_at(0, 32)
        bench.get_at(FIELDS["UWB"].offset + 32 * (step % 3), 32)
        if step % 7 == 0:
            bench.put("NOTES", bytes((15, *(60, 1) * 15)))
            bench.write(ADDRESS, bytes((194, step % 10)) + bytes(28))
            bench.run(1e-4)
        if bench.sent():
            bench.feed(uwb)


def test_the_slave_never_holds_the_bus_for_long_nor_misses_a_start(bench):
    bench.i2c_stats()
    busy_second(bench, 1.0)
    stats = bench.i2c_stats()
    assert stats.transfers > 400
    assert (stats.deaf, stats.refused) == (0, 0), "with a gap of 100 us"
    assert stats.stretch_longest <= LIMIT
    assert stats.stretch_shortest >= 16e-6, "two edges of the BCM2835's clock at 62.5 kHz, one at 40"


def test_interrupts_are_never_off_for_long(bench):
    bench.call("watch", 1)
    busy_second(bench, 0.35)
    off = bench.call("interrupts_off") / 16e6
    assert 5e-6 < off <= LIMIT


@pytest.mark.slow
def test_the_same_for_twenty_seconds_and_at_400_khz(bench):
    bench.call("watch", 0)
    for hz in (100e3, 400e3):
        bench.call("i2c_speed", hz)
        busy_second(bench, 10.0)
        stats = bench.i2c_stats()
        assert (stats.deaf, stats.refused) == (0, 0)
        assert stats.stretch_longest <= LIMIT
    assert bench.call("interrupts_off") / 16e6 <= LIMIT
    bench.wheels(0, 0)
    bench.run(0.01)
    assert bench.encoders() == tuple((count + 0x8000) % 0x10000 - 0x8000 for count in bench.counts())


def test_every_transfer_is_heard_at_any_phase_of_the_firmware(bench):
    """The gap is 100 us, the moment of the transfer against the millisecond tick is drawn through."""
    bench.wheels(5100, 4700)
    for step in range(300):
        bench.get("ENCODERS")
        bench.run(step * 3.7e-6)
    assert bench.i2c_stats().deaf == 0


def test_a_slave_left_in_the_middle_lets_go_of_the_bus(bench):
    """A clock pulse lost, or a master that died: the slave still sends a 0 and no START can be made."""
    bench.write(ADDRESS, bytes((255,)))
    bench.run(1e-4)
    assert bench.call("i2c_abandon_read", ADDRESS) == 0
    bench.run(0.010)
    assert refused(lambda: bench.write(ADDRESS, b"\0"), errno.ETIMEDOUT), "SDA is held"
    bench.run(0.025)
    assert bench.number("BUS_RESETS") == 1
    assert bench.number("REFUSED") == 0


def test_a_write_the_master_never_finished_is_forgotten(bench):
    data = bytes((FIELDS["MOTORS"].offset,)) + struct.pack("<2h", 100, 100)
    bench.call("i2c_write", ADDRESS, data, len(data), 0)
    bench.run(0.040)
    assert bench.number("BUS_RESETS") == 1
    assert bench.motors() == (0.0, 0.0)
    bench.run(0.3)
    assert bench.number("BUS_RESETS") == 1


def test_long_reads_are_no_abandoned_ones(bench):
    bench.get_at(0, 255)
    bench.call("i2c_speed", 50e3)
    assert len(bench.get_at(0, 255)) == 255
    assert bench.number("BUS_RESETS") == 0


def test_the_bus_is_no_slower_than_with_the_thesis_firmware(bench):
    """Thesis 2.2.5 and Pololu give 21 kbit/s read and 53 written for 8 bytes at 100 kHz; we must not be slower."""
    start = bench.now
    for _ in range(20):
        bench.get_at(FIELDS["ENCODERS"].offset, 8)
    reading = 20 * 64 / (bench.now - start)
    start = bench.now
    for _ in range(20):
        bench.put("LEDS", bytes(7))
    writing = 20 * 56 / (bench.now - start)
    assert reading > 35e3
    assert writing > 45e3


def test_the_projects_driver_runs_on_it_unchanged(bench):
    driver = Balboa(bench, lambda: bench.now, bench.run)
    driver.set_up()
    bench.battery(7.4)
    bench.press(b=True)
    driver.write_leds(True, False, True)
    bench.run(0.25)
    driver.write_motors(0.5, -2.0)
    bench.run(0.01)
    assert bench.motors() == (0.5, -1.0)
    assert bench.leds() == (True, False, True)
    seen = driver.read_housekeeping()
    assert (seen.buttons, seen.stopped_by_watchdog) == ((False, True, False), False)
    assert seen.battery == pytest.approx(7.4, abs=0.02)
    bench.wheels(1000, -500)
    bench.run(0.1)
    bench.wheels(0, 0)
    bench.run(0.001)
    driver.select(FIELDS["ENCODERS"].offset)
    assert driver.fetch_motion()[0][:2] == bench.counts()
