"""The robot's own balancer and slack tasks at clocks of the I2C bus that Pis have, and with the CPU time of a tick that
they may take: what goes on, and what gives way and is named."""

import pytest
from conftest import thinned

from bench.rigs.timed_robot import TimedResult, TimedRobot

CLOCKS_KHZ = (40.0, 50.0, 62.5, 80.0, 100.0)
CPU_MS = (0.0, 0.5, 1.0, 1.5, 2.0)
DEFAULT = {(62.5, 0.0), (62.5, 1.0), (50.0, 1.0), (40.0, 0.5), (40.0, 2.0), (100.0, 2.0)}
"""Cells that are looked at in every run."""


def carries_uwb(clock: float, cpu: float) -> bool:
    """Whether 10 reports a second fit what a control step leaves of the wire."""
    return clock >= 50.0 or cpu <= 0.5


def carries_display(clock: float, cpu: float) -> bool:
    return clock >= 62.5 or (clock >= 50.0 and cpu <= 1.5)


def measured(clock: float, cpu: float, seconds: float) -> TimedResult:
    return TimedRobot(scl=clock * 1e3, cpu=cpu * 1e-3).measure(seconds)


def judge(found: TimedResult, clock: float, cpu: float) -> None:
    assert found.upright
    assert found.presses == 1.0
    if cpu <= 1.0:
        assert found.missed == 0
    if carries_uwb(clock, cpu):
        assert found.uwb >= 9.0
        assert found.uwb < 9.5 or "uwb" not in found.behind
    else:
        assert "uwb" in found.behind
    if clock > 40.0 or cpu <= 1.5:
        assert found.battery >= 0.8
    else:
        assert "battery" in found.behind
    if carries_display(clock, cpu):
        assert found.screen_s is not None
        assert found.screen_s < 5.0
    else:
        assert found.screen_s is not None or "display" in found.behind


@pytest.mark.parametrize(("clock", "cpu"), thinned(sorted(DEFAULT)))
def test_uwb_battery_buttons_and_display_go_on_or_are_named(clock: float, cpu: float) -> None:
    judge(measured(clock, cpu, 10.0), clock, cpu)


@pytest.mark.slow
@pytest.mark.parametrize("cpu", CPU_MS)
@pytest.mark.parametrize("clock", CLOCKS_KHZ)
def test_the_matrix_of_clocks_and_cpu_times(clock: float, cpu: float) -> None:
    judge(measured(clock, cpu, 20.0), clock, cpu)


def test_at_100_khz_nothing_is_read_along_and_the_motors_wait_for_nothing() -> None:
    assert measured(100.0, 0.5, 5.0).step_max < 4e-3


def test_a_clock_that_drops_while_the_robot_balances_costs_few_ticks() -> None:
    """The firmware of a Pi lowers its core clock when nothing happens."""
    robot = TimedRobot(scl=100e3, cpu=0.5e-3)
    robot.stand()
    robot.run(1.0)
    robot.robot.scl = 62.5e3
    before = robot.missed
    robot.run(5.0)
    assert robot.missed - before <= 3
    assert robot.balancer.mode == "balancing"
    assert robot.tasks.behind == ""
    assert 1.0 / robot.balancer.wire.bit_s == pytest.approx(62.5e3, rel=0.03)


def test_a_bus_that_is_too_slow_says_so_once_and_when_it_is_over() -> None:
    robot = TimedRobot(scl=40e3, cpu=1.5e-3)
    robot.stand()
    robot.balancer.notices.clear()
    robot.run(20.0)
    assert "uwb" in robot.tasks.behind
    told = [text for about, text in robot.balancer.notices if about == "i2c"]
    assert any(text.startswith("no time for uwb") and "SCL 40 kHz" in text for text in told)
    assert len(told) <= 3, "what gives way changes little"
    robot.robot.scl = 100e3
    robot.run(15.0)
    assert robot.tasks.behind == ""
    assert ("i2c", "time for all tasks (SCL 100 kHz)") in robot.balancer.notices
