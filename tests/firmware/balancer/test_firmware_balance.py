"""The robot stands: the balancer's own code, over simulated I2C, through the real firmware, on the simulated body."""

import math

import pytest
from elf_robot import ElfRobot

from services.balancer.balancer import Balancer
from services.balancer.core.control.body import body_model
from services.balancer.core.control.lqr import PERIOD_S
from services.balancer.core.devices import balboa
from services.balancer.i2c import NOBODY
from services.balancer.slack_tasks import MARGIN_S, SlackTasks
from services.dwm.core.module.tlv import AnchorRange, Location, Position, encode_location
from swarm.config.types import Body
from swarm.messages import Battery, Uwb

pytest_plugins = ("firmware_fixtures",)

MODEL = body_model("zero2w", Body())
ANSWER = encode_location(
    Location(
        Position(1.0, 2.0, 0.1, 90),
        tuple(AnchorRange(f"C93{n}", 1.0 + n, 95, Position(float(n), 0.0, 0.0, 100)) for n in range(4)),
    )
)


class Standing:
    """A robot with its balancer, ticked as its loop does; the DWM1001 answers every poll."""

    def __init__(self, bench, cpu: float = 0.0) -> None:
        """`cpu` is the CPU time of a tick, s: half of it passes before the motors are commanded, half after."""
        bench.battery(7.4)
        self.cpu = cpu
        self.bench = bench
        self.robot = ElfRobot(bench, MODEL)
        self.balancer = Balancer(self.robot, MODEL, 0.0, self.robot.clock, self.robot.sleep, start_mode="stand")
        self.tasks = SlackTasks(self.balancer, self.robot.clock)
        read = self.balancer._read
        self.balancer._read = lambda now: (read(now), self.robot.sleep(cpu / 2))[0]
        self.missed = 0
        self.news: list[object] = []
        self.tilts: list[float] = []
        self.longest_tick = self.longest_slack = 0.0

    def run(self, seconds: float, until=lambda: False) -> None:
        end = deadline = self.robot.clock()
        end += seconds
        while deadline < end and not until():
            self.robot.run_to(deadline)
            self.balancer.step(self.robot.clock())
            self.longest_tick = max(self.longest_tick, self.robot.clock() - deadline)
            self.robot.sleep(self.cpu / 2)
            self.balancer.show_leds(self.robot.clock())
            self.news += self.tasks.run(deadline + PERIOD_S)
            self.longest_slack = max(self.longest_slack, self.robot.clock() - deadline)
            if self.bench.sent():
                self.bench.feed(ANSWER)
            self.tilts.append(self.robot.body.tilt)
            deadline += PERIOD_S
            if self.robot.clock() > deadline:
                self.missed += 1
                deadline += PERIOD_S


def upright(bench, cpu: float = 0.0) -> Standing:
    standing = Standing(bench, cpu)
    standing.run(6.0, until=lambda: standing.balancer.mode == "balancing")
    assert standing.balancer.mode == "balancing", standing.balancer.fault
    standing.tilts.clear()
    standing.longest_tick = standing.longest_slack = 0.0
    standing.missed = 0
    standing.news.clear()
    return standing


def test_a_robot_with_the_firmware_stands_for_five_seconds(bench):
    standing = upright(bench)
    standing.run(5.0)
    assert standing.balancer.mode == "balancing"
    assert max(map(abs, standing.tilts)) < math.radians(10)
    assert standing.balancer.bus_errors == 0


def at_clock(bench, scl: float, cpu: float, seconds: float) -> Standing:
    """Balancing at a clock of the bus, Hz, and with a CPU time of each tick, s; upright and without a missed tick."""
    bench.call("i2c_speed", scl)
    standing = upright(bench, cpu)
    standing.run(seconds)
    assert (standing.balancer.mode, standing.balancer.bus_errors, standing.tasks.errors) == ("balancing", 0, 0)
    assert max(map(abs, standing.tilts)) < math.radians(10)
    assert 1.0 / standing.balancer.wire.bit_s == pytest.approx(scl, rel=0.1)
    assert standing.missed == 0
    return standing


def reports_a_second(standing: Standing, seconds: float) -> float:
    return len({each.sequence for each in standing.news if isinstance(each, Uwb) and each.ranges}) / seconds


def test_reports_come_through_the_firmware_at_the_clock_of_an_idle_pi(bench):
    standing = at_clock(bench, 62.5e3, 1e-3, 3.0)
    assert reports_a_second(standing, 3.0) >= 9.0
    told = [each for each in standing.news if isinstance(each, Uwb) and each.ranges][-1]
    assert [(each.anchor, each.distance, each.x) for each in told.ranges] == [
        (f"C93{n}", 1.0 + n, float(n)) for n in range(4)
    ]


def test_the_firmware_holds_a_bus_at_400_khz(bench):
    bench.i2c_stats()
    standing = at_clock(bench, 400e3, 2e-3, 2.0)
    assert reports_a_second(standing, 2.0) >= 9.0
    stats = bench.i2c_stats()
    assert (stats.deaf, stats.refused) == (0, 0)
    assert standing.tasks.behind == ""


@pytest.mark.slow
@pytest.mark.parametrize("cpu", [0.0, 0.5e-3, 1e-3])
@pytest.mark.parametrize("scl", [40e3, 50e3, 62.5e3, 80e3, 100e3])
def test_the_matrix_of_clocks_and_cpu_times_through_the_firmware(bench, scl, cpu):
    standing = at_clock(bench, scl, cpu, 10.0)
    if scl > 40e3 or cpu <= 0.5e-3:
        assert reports_a_second(standing, 10.0) >= 9.0
    assert any(isinstance(each, Battery) for each in standing.news)


@pytest.mark.slow
def test_a_robot_with_the_firmware_stands_for_a_minute_while_all_tasks_run(bench):
    standing = upright(bench)
    bench.i2c_stats()
    bench.call("watch", 0)
    standing.run(60.0)
    assert standing.balancer.mode == "balancing"
    assert standing.balancer.bus_errors == 0
    assert standing.balancer.battery == pytest.approx(7.4, abs=0.02)
    rms = math.sqrt(sum(tilt**2 for tilt in standing.tilts) / len(standing.tilts))
    assert max(map(abs, standing.tilts)) < math.radians(10)
    assert rms < math.radians(2)
    assert abs(standing.robot.body.travel) < 0.5, "it stays where it is"
    stats = bench.i2c_stats()
    assert (stats.deaf, stats.refused) == (0, 0)
    assert stats.stretch_longest < 50e-6
    assert bench.call("interrupts_off") / 16e6 < 50e-6
    assert standing.longest_tick < 0.004, "of the bus for one control step"
    assert standing.longest_slack < PERIOD_S - MARGIN_S, "with what else is done on the bus"
    assert standing.tasks.errors == 0
    reports = [news for news in standing.news if isinstance(news, Uwb)]
    assert {report.sequence for report in reports} >= set(range(reports[0].sequence, 590))
    assert reports[-1].lost == 0
    assert reports[-1].ranges[0].anchor == "C930"
    bench.run(0.001)
    assert bench.report().sequence >= 590, "the UWB reports went on"
    assert bench.number("UWB_BAD") == 0
    assert bench.get("ENCODER_ERRORS") == b"\0\0"
    assert bench.call("resets") == 0


def test_a_robot_with_the_firmware_recovers_from_a_push(bench):
    standing = upright(bench)
    standing.run(1.0)
    standing.robot.body.push(0.02)
    standing.run(3.0)
    assert standing.balancer.mode == "balancing"
    assert abs(standing.tilts[-1]) < math.radians(5)


def test_a_balancer_that_dies_leaves_motors_that_stop(bench):
    standing = upright(bench)
    standing.run(1.0)
    standing.robot.body.push(0.015)  # it is working hard when it dies
    standing.run(0.05)
    bench.run(0.001)
    assert bench.motors() != (0.0, 0.0)
    died = bench.now
    bench.run_until(lambda: bench.motors() == (0.0, 0.0), 0.21)
    assert bench.now - died > 0.18
    bench.run(1.0)
    assert bench.motors() == (0.0, 0.0)
    standing.robot.run_to(bench.now + 1.0)
    assert abs(standing.robot.body.tilt) > math.radians(100), "it lies"


def test_a_robot_with_the_firmware_lies_down_on_command(bench):
    standing = upright(bench)
    standing.balancer.command("rest", standing.robot.clock())
    standing.run(0.1)
    assert standing.balancer.mode == "idle"
    assert bench.motors() == (0.0, 0.0)


def test_a_firmware_that_restarts_is_named_and_survived(bench):
    """A brown-out takes encoders and layout back to zero in the middle of balancing."""
    standing = upright(bench)
    standing.run(1.0)
    bench.call("reset", 4)
    bench.run(0.01)
    standing.run(1.0)
    assert standing.balancer.mode in ("balancing", "fault")
    standing.balancer.motors_off()
    bench.run(0.001)
    assert bench.motors() == (0.0, 0.0)


def test_a_robot_drives_and_lies_down_through_the_firmware(bench):
    standing = upright(bench)
    standing.balancer.drive(0.2, 1.0, 3.0, standing.robot.clock())
    standing.run(2.0)
    assert standing.balancer.mode == "balancing"
    assert standing.robot.body.speed == pytest.approx(0.2, abs=0.1)
    assert standing.robot.body.turn_rate == pytest.approx(1.0, abs=0.3)
    standing.balancer.command("lie", standing.robot.clock())
    standing.run(2.5)
    assert (standing.balancer.mode, standing.balancer.posture) == ("idle", "front")
    bench.run(0.001)
    assert bench.motors() == (0.0, 0.0)


@pytest.mark.parametrize("manoeuvre", ["drive", "lie"])
def test_a_balancer_that_dies_in_a_manoeuvre_leaves_motors_that_stop(bench, manoeuvre):
    """kill -9 in the middle: the last motor write is the last thing the firmware hears."""
    standing = upright(bench)
    if manoeuvre == "drive":
        standing.balancer.drive(0.5, 0.0, 10.0, standing.robot.clock())
    else:
        standing.balancer.command("lie", standing.robot.clock())
    standing.run(0.1)
    bench.run(0.001)
    assert bench.motors() != (0.0, 0.0)
    bench.run(0.205)
    assert bench.motors() == (0.0, 0.0)


def test_transfers_that_stop_in_the_middle_do_not_throw_it(bench):
    """The Pi's master was reset in the middle of a read: the ATmega holds on for 30 ms, then drops it."""
    standing = upright(bench)
    for _ in range(5):
        standing.run(0.5)
        bench.run(2e-4)  # the last transfer's STOP is handled
        assert bench.call("i2c_abandon_read", balboa.ADDRESS) == 0
        standing.run(0.5)
    assert (standing.balancer.mode, standing.balancer.fault) == ("balancing", None)
    assert standing.balancer.balboa.read_housekeeping().bus_resets in range(6)


def test_nobody_answers_at_the_address_that_frees_the_bus(bench):
    bench.i2c_stats()
    with pytest.raises(OSError, match="I/O"):
        bench.read(NOBODY, 1)
    assert bench.i2c_stats().refused == 1
    assert bench.number("VERSION") == balboa.LAYOUT_VERSION
