"""Registers of the two devices: the drivers' arithmetic, and the simulated devices that answer it."""

import contextlib
import errno
import math
import os
import random
import struct
import subprocess
import sys

import pytest
from balancer_rig import NO_OFFSETS
from device_rig import Bench
from hypothesis import given
from hypothesis import strategies as st

from services.balancer.core.devices import balboa, imu
from services.balancer.device_drivers import Balboa, Imu
from services.balancer.i2c import PATIENCE_S, RETRY_S, BusInUseError, KernelBus, open_patiently
from sim.core.devices import SimulatedRobot, draw_errors
from swarm.errors import LocalError, RemoteError

words = st.integers(-0x8000, 0x7FFF)


@given(st.tuples(*[words] * 6))
def test_imu_words_become_si_units(sample: tuple[int, ...]) -> None:
    block = struct.pack("<6h", *sample)
    if sample[3:] == (0, 0, 0):
        with pytest.raises(RemoteError, match="reset"):
            imu.decode(block)
        return
    reading = imu.decode(block)
    assert reading.pitch_rate == pytest.approx(math.radians(sample[1] * 0.035))
    assert reading.up == pytest.approx(sample[3] * 0.061e-3 * 9.80665)
    assert reading.back == pytest.approx(sample[5] * 0.061e-3 * 9.80665)
    assert -math.pi <= imu.gravity_tilt(reading) <= math.pi


@given(st.binary(max_size=20))
def test_blocks_of_any_length_are_decoded_or_refused(block: bytes) -> None:
    for decode in (imu.decode, balboa.decode_motion, balboa.decode_housekeeping, balboa.decode_progress):
        with contextlib.suppress(RemoteError):
            decode(block)


@given(st.floats(-2, 2), st.floats(-2, 2))
def test_motor_commands_survive_the_wire(left: float, right: float) -> None:
    data = balboa.encode_motors(left, right)
    for sent, got in zip((left, right), balboa.decode_motors(data), strict=True):
        assert got == pytest.approx(max(-1.0, min(1.0, sent)), abs=0.5 / balboa.MOTOR_TOP)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_motor_command_that_is_no_number_is_refused(bad: float) -> None:
    with pytest.raises(LocalError, match="not finite"):
        balboa.encode_motors(0.1, bad)


@given(words, words)
def test_an_encoder_wraps_the_short_way(old: int, new: int) -> None:
    step = balboa.encoder_step(old, new)
    assert -0x8000 <= step <= 0x7FFF
    assert (old + step - new) % 0x10000 == 0


def test_an_imu_that_was_not_set_up_gives_no_data() -> None:
    bench = Bench()
    with pytest.raises(RemoteError, match="reset"):
        bench.imu.read()
    bench.imu.set_up()
    assert bench.imu.read().up == pytest.approx(imu.STANDARD_GRAVITY, rel=1e-3)


@pytest.mark.parametrize("degrees", [-110, -30, 0, 30, 110])
def test_tilt_from_gravity_has_the_sign_of_the_body(degrees: int) -> None:
    bench = Bench(tilt=math.radians(degrees))
    bench.imu.set_up()
    assert imu.gravity_tilt(bench.imu.read()) == pytest.approx(math.radians(degrees), abs=1e-3)


def test_trim_is_what_the_imu_shows_at_balance() -> None:
    bench = Bench(trim=0.19)
    bench.imu.set_up()
    assert imu.gravity_tilt(bench.imu.read()) == pytest.approx(0.19, abs=1e-3)


def test_known_acceleration_is_taken_out_of_gravity() -> None:
    tilt, acceleration, g = 0.2, 3.0, imu.STANDARD_GRAVITY
    up = g * math.cos(tilt) + acceleration * math.sin(tilt)
    back = g * math.sin(tilt) - acceleration * math.cos(tilt)
    assert imu.gravity_tilt(imu.ImuReading(0.0, up, back), tilt, acceleration) == pytest.approx(tilt)


def test_gyro_reads_the_fall_in_the_range_that_was_set() -> None:
    bench = Bench(tilt=0.1, held=False)
    bench.imu.set_up()
    bench.now += 0.2
    assert bench.imu.read().pitch_rate == pytest.approx(bench.body.tilt_rate, abs=imu.GYRO_SCALE)
    assert bench.body.tilt_rate > 0.1
    bench.bus.write(imu.ADDRESS, bytes((imu.CTRL2_G, 0x5C)))  # 2000 dps: half the counts
    assert bench.imu.read().pitch_rate == pytest.approx(bench.body.tilt_rate / 2, abs=imu.GYRO_SCALE)


def test_sensor_errors_are_drawn_from_the_seed() -> None:
    assert draw_errors(random.Random(3)) == draw_errors(random.Random(3)) != draw_errors(random.Random(4))


def test_another_imu_is_refused_by_name() -> None:
    with pytest.raises(RemoteError, match=r"0x6A, expected 0x69 \(LSM6DS33\) or 0x6C \(LSM6DSO\)"):
        imu.check_identity(0x6A)
    for identity in (0x69, 0x6C):
        imu.check_identity(identity)


def test_another_layout_is_refused() -> None:
    bench = Bench()
    bench.robot.atmega._buffer[balboa.VERSION] = 9
    with pytest.raises(RemoteError, match="layout version 9, expected 2"):
        bench.balboa.set_up()


def test_an_address_without_a_device_is_a_remote_io_error() -> None:
    with pytest.raises(OSError, match="Remote I/O") as failure:
        Bench().bus.read(0x3D, 1)
    assert failure.value.errno == 121


def test_motors_stop_200_ms_after_the_last_command() -> None:
    bench = Bench()
    bench.balboa.write_motors(0.3, 0.3)
    bench.now += 0.199
    bench.balboa.select(balboa.ENCODERS)
    assert bench.robot.atmega.motors == (0.3, 0.3)
    bench.now += 0.002
    assert not bench.balboa.read_housekeeping().stopped_by_watchdog or bench.robot.atmega.motors == (0.0, 0.0)
    assert bench.balboa.read_housekeeping().stopped_by_watchdog
    bench.balboa.write_motors(0.0, 0.0)
    assert not bench.balboa.read_housekeeping().stopped_by_watchdog


def test_the_watchdog_acts_at_its_time_however_late_we_look() -> None:
    """The motors ran for 200 ms of the second in which nobody looked."""
    ways = []
    for looks in ([1.0], [0.2, 1.0]):
        bench = Bench()
        bench.balboa.write_motors(0.05, 0.05)
        for time in looks:
            bench.now = 10.0 + time
            bench.balboa.select(0)
        ways.append((bench.body.x, bench.body.tilt))
    assert ways[0] == pytest.approx(ways[1])


def test_buttons_and_battery_are_read_from_the_atmega() -> None:
    bench = Bench()
    bench.robot.atmega.press(0b101)
    read = bench.balboa.read_housekeeping()
    assert read.buttons == (True, False, True)
    assert read.battery == pytest.approx(7.4)


def test_the_driver_writes_the_leds() -> None:
    bench = Bench()
    bench.balboa.write_leds(True, False, True)
    assert bench.robot.atmega.leds == (True, False, True)


def test_the_atmega_is_left_alone_after_each_transfer() -> None:
    bench = Bench()
    bench.balboa.select(balboa.ENCODERS)
    assert bench.slept == []
    bench.balboa.fetch_motion()
    assert bench.slept == [pytest.approx(balboa.PAUSE_S)]
    bench.now += balboa.PAUSE_S
    bench.balboa.write_motors(0.0, 0.0)  # time went by meanwhile: no need to sleep
    assert len(bench.slept) == 1


def test_bus_time_of_a_tick_at_100_khz() -> None:
    """Byte counts of one tick: below the 4 ms it may take."""
    bench = Bench()
    bench.imu.set_up()
    before = bench.robot.bits
    bench.balboa.select(balboa.ENCODERS)
    bench.imu.read()
    bench.balboa.fetch_motion()
    bench.balboa.write_motors(0.1, 0.1)
    bus_s = (bench.robot.bits - before) * 10e-6
    assert bus_s == pytest.approx(2.80e-3, abs=0.05e-3)


def test_the_real_bus_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "smbus2", None)
    with pytest.raises(LocalError, match="smbus2"):
        KernelBus()


class FakeSmbus2:
    """The part of smbus2 that is used, in front of the simulated devices."""

    class i2c_msg(list):
        @classmethod
        def write(cls, address, data):
            message = cls(data)
            message.address, message.is_read = address, False
            return message

        @classmethod
        def read(cls, address, count):
            message = cls([0] * count)
            message.address, message.is_read = address, True
            return message

    def __init__(self, robot: SimulatedRobot) -> None:
        self.robot = robot
        self.transactions: list[int] = []
        self.fd = -1

    def SMBus(self, number: int) -> "FakeSmbus2":
        self.fd = os.memfd_create("i2c")  # a file of its own: the adapter is locked
        return self

    def i2c_rdwr(self, *messages) -> None:
        self.transactions.append(len(messages))
        for message in messages:
            if message.is_read:
                message[:] = self.robot.read(message.address, len(message), 10.0)
            else:
                self.robot.write(message.address, bytes(message), 10.0)

    def close(self) -> None:
        self.transactions.append(0)
        os.close(self.fd)


def test_the_real_bus_through_smbus2(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    fake = FakeSmbus2(Bench().robot)
    monkeypatch.setitem(sys.modules, "smbus2", fake)
    monkeypatch.setattr("services.balancer.i2c.Path", lambda _: tmp_path)
    ioctls = []
    monkeypatch.setattr("services.balancer.i2c.fcntl.ioctl", lambda *arguments: ioctls.append(arguments))
    bus = KernelBus()
    Imu(bus).set_up()
    assert imu.gravity_tilt(Imu(bus).read()) == pytest.approx(0.0, abs=1e-3)
    assert fake.transactions == [2, 1, 1, 1, 2, 2]  # a register read is one combined transaction
    drive = Balboa(bus, lambda: 10.0, lambda _: None)
    drive.write_motors(0.25, -0.25)
    drive.select(balboa.MOTORS)
    assert bus.read(balboa.ADDRESS, 4) == balboa.encode_motors(0.25, -0.25)
    assert ioctls == [(fake.fd, 0x0702, 2)], "a transfer is given up after 20 ms, not after a second"
    bus.recover()
    assert fake.transactions[-1] == 1
    assert bus.untimed() == 0.0
    bus.close()
    assert fake.transactions[-1] == 0


def test_the_real_bus_needs_its_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "smbus2", object())
    with pytest.raises(LocalError, match="/dev/i2c-77 is missing"):
        KernelBus(77)


class Reluctant(FakeSmbus2):
    """A device that udev gives to the balancer after some attempts to open it."""

    refusals = 3

    def SMBus(self, number: int) -> FakeSmbus2:
        if self.refusals:
            self.refusals -= 1
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        return super().SMBus(number)


def test_at_a_boot_the_device_is_waited_for(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    """A balancer that ended at once would stay down: its exit code says that a person is needed."""
    fake, waited = Reluctant(Bench().robot), []
    monkeypatch.setitem(sys.modules, "smbus2", fake)
    monkeypatch.setattr("services.balancer.i2c.Path", lambda _: tmp_path)
    monkeypatch.setattr("services.balancer.i2c.fcntl.ioctl", lambda *_: None)
    open_patiently(waited.append).close()
    assert waited == [RETRY_S] * 3
    fake.refusals = 1000
    with pytest.raises(LocalError, match="is this user in the group i2c"):
        open_patiently(waited.append)
    assert sum(waited[3:]) == pytest.approx(PATIENCE_S)


HOLD = """
import fcntl, sys, time
device = open(sys.argv[1])
fcntl.flock(device, fcntl.LOCK_EX)
print(flush=True)
time.sleep(60)
"""


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch, tmp_path):
    """A file in the place of /dev/i2c-1."""
    made = tmp_path / "i2c-1"
    made.touch()

    class OfFile(FakeSmbus2):
        def SMBus(self, number: int) -> FakeSmbus2:
            bus = FakeSmbus2(self.robot)
            bus.fd = os.open(made, os.O_RDWR)
            return bus

    monkeypatch.setitem(sys.modules, "smbus2", OfFile(Bench().robot))
    monkeypatch.setattr("services.balancer.i2c.Path", lambda _: made)
    monkeypatch.setattr("services.balancer.i2c.fcntl.ioctl", lambda *_: None)
    return made


def test_one_process_at_a_time_has_the_bus(device) -> None:
    """A second master would move the ATmega's index between the first one's write and read."""
    first = KernelBus()
    with pytest.raises(BusInUseError, match="in use by another process"):
        KernelBus()
    first.close()
    KernelBus().close()


def test_the_balancer_waits_for_a_process_that_has_the_bus_and_begins_when_that_has_crashed(device, caplog) -> None:
    """It waits for longer than for a missing device, and does not end: a person is needed for nothing."""
    holder = subprocess.Popen([sys.executable, "-c", HOLD, device], stdout=subprocess.PIPE)
    with contextlib.closing(holder.stdout):
        holder.stdout.readline()
        waited = []

        def wait(seconds: float) -> None:
            waited.append(seconds)
            if sum(waited) > 2 * PATIENCE_S:
                holder.kill()
                holder.wait()

        open_patiently(wait).close()
    assert sum(waited) > 2 * PATIENCE_S
    assert [record.message for record in caplog.records] == [
        f"the balancer waits for the bus: {device} is in use by another process (the balancer, swarm flash or swarm "
        "measure i2c): wait for its end"
    ]


def test_a_library_that_is_missing_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "smbus2", None)
    waited: list[float] = []
    with pytest.raises(LocalError, match="smbus2"):
        open_patiently(waited.append)
    assert waited == []


@pytest.mark.parametrize(("control", "torn"), [(imu.SETUP[0][1], False), (0x04, True)], ids=["BDU", "no BDU"])
def test_words_are_torn_by_a_sample_within_the_read_unless_block_data_update_is_on(control: int, torn: bool) -> None:
    """The rate stands at a border of the high byte, where noise of a count makes a torn word wrong by 256."""
    bench = Bench(errors=NO_OFFSETS._replace(gyro_offset=256 * imu.GYRO_SCALE))
    bench.imu.set_up()
    bench.bus.write(imu.ADDRESS, bytes((imu.CTRL3_C, control)))
    rates = []
    for _ in range(2000):
        bench.now += 0.01
        rates.append(bench.imu.read().pitch_rate / imu.GYRO_SCALE - 256)
    assert any(abs(each) > 100 for each in rates) == torn


def test_an_lsm6dso_is_taken_as_well() -> None:
    bench = Bench()
    bench.robot.imu.identity = imu.LSM6DSO
    bench.robot.imu.reset()
    bench.imu.set_up()
    assert bench.imu.read().up == pytest.approx(imu.STANDARD_GRAVITY, rel=0.05)


@pytest.mark.parametrize("flipped", [(False, False), (True, False), (False, True), (True, True)])
def test_a_flipped_motor_is_commanded_the_other_way_round(flipped: tuple[bool, bool]) -> None:
    bench = Bench()
    driver = Balboa(bench.bus, lambda: bench.now, lambda seconds: None, flipped)
    driver.write_motors(0.5, 0.25)
    signs = [-1 if each else 1 for each in flipped]
    assert bench.robot.atmega.motors == (0.5 * signs[0], 0.25 * signs[1])
