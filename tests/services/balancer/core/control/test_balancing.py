"""The whole balancer against the simulated robot under virtual time: minutes of balancing in fractions of a second."""

import errno
import math
import random

import pytest
from balancer_rig import CONFIGURED, OTHER, PLANTS, Rig, scaled, upright
from conftest import examples, thinned

from services.balancer.balancer import RETRY_S, TOLERATED_ERRORS
from services.balancer.core.devices import balboa, imu


def on_its_feet(rig: Rig) -> bool:
    return rig.balancer.mode == "balancing" and abs(rig.body.tilt) < math.radians(10)


def stands(rig: Rig) -> None:
    assert on_its_feet(rig)
    assert rig.worst_tilt < math.radians(8)
    assert math.hypot(rig.body.x, rig.body.y) < 0.2
    assert rig.balancer.bus_errors == 0


@pytest.mark.parametrize("name", ["configured", "other"])
def test_a_robot_stands_upright_for_a_minute(name: str) -> None:
    """One set of gains, from the configured body, on both estimates of it."""
    stands(upright(plant=PLANTS[name], seed=len(name)).run(60))


@pytest.mark.costly
@pytest.mark.parametrize("name", thinned(name for name in PLANTS if "%" in name))
def test_upright_with_each_parameter_a_fifth_off(name: str) -> None:
    stands(upright(plant=PLANTS[name], seed=len(name)).run(examples(30)))


def test_a_standing_robot_settles_to_a_fraction_of_a_degree() -> None:
    rig = upright().run(15)
    rig.worst_tilt = 0.0
    rig.run(20)
    assert rig.worst_tilt < math.radians(2)


def test_a_standing_robot_knows_its_place() -> None:
    rig = upright(seed=7).run(30)
    estimate = rig.balancer.estimate
    assert estimate.way == pytest.approx(rig.body.travel, abs=0.005)
    assert estimate.tilt == pytest.approx(rig.body.tilt, abs=math.radians(3))


@pytest.mark.parametrize("plant", [CONFIGURED, OTHER], ids=["configured", "other"])
@pytest.mark.parametrize("momentum", [0.1, -0.1, 0.2, -0.2])
def test_a_standing_robot_recovers_from_a_push(plant, momentum: float) -> None:
    """0.2 N s: a body of 0.4 kg is set into motion with half a metre a second."""
    rig = upright(plant=plant).run(3)
    rig.body.push(momentum)
    rig.run(10)
    assert on_its_feet(rig)
    assert abs(rig.body.x) < 0.2


@pytest.mark.parametrize("plant", [CONFIGURED, OTHER], ids=["configured", "other"])
@pytest.mark.parametrize("mean", thinned([0.010, 0.005]))
def test_a_standing_robot_bears_a_loop_that_is_late_at_random(plant, mean: float) -> None:
    rng = random.Random(11)
    rig = upright(plant=plant, lateness=lambda _tick: rng.expovariate(1 / mean)).run(60)
    assert on_its_feet(rig)


@pytest.mark.parametrize("plant", [CONFIGURED, OTHER], ids=["configured", "other"])
def test_a_standing_robot_bears_a_stall_of_150_ms(plant) -> None:
    rig = upright(plant=plant).run(5)
    for repeat in range(10):
        rig.lateness = lambda tick, at=rig.tick + repeat % 7: 0.150 if tick == at else 0.0
        rig.run(5)
        assert on_its_feet(rig)


def test_missed_ticks_are_left_out() -> None:
    rig = upright()
    before = rig.tick
    rig.lateness = lambda tick: 0.150 if tick == before else 0.0
    rig.run(1.0)
    assert rig.tick - before == 100 - 15


def test_encoders_wrap_while_it_stands() -> None:
    rig = Rig()
    rig.body.travel = (0x8000 - 20) / CONFIGURED.counts_per_turn * math.tau * CONFIGURED.wheel_radius
    rig.run(30)
    assert on_its_feet(rig)
    assert abs(rig.body.x) < 0.2


def test_a_clock_that_jumps_back_does_not_throw_it() -> None:
    rig = upright().run(5)
    step = rig.balancer.step
    rig.balancer.step = lambda now: step(now - 1.0 if rig.tick % 50 == 0 else now)
    rig.run(20)
    assert on_its_feet(rig)


def test_wrong_upright_is_learned() -> None:
    """The sensor sits two degrees other than the config says; it ends up at its place nevertheless."""
    rig = Rig(start_mode="stand")
    rig.robot.imu._trim = math.radians(2)
    rig.run(60)
    assert on_its_feet(rig)
    assert abs(rig.body.x) < 0.06


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("name", thinned(name for name in PLANTS if name.startswith("configured") or name == "other"))
def test_a_robot_stands_up_from_front_and_back(name: str, side: int) -> None:
    rig = Rig(PLANTS[name], tilt=side * math.radians(110), held=False).run(15)
    assert on_its_feet(rig)
    assert rig.balancer.fault is None


def test_a_robot_that_is_too_weak_gives_up_standing_up() -> None:
    weak = scaled(CONFIGURED, "stall_torque", 0.3)
    rig = Rig(weak, tilt=math.radians(110), held=False).run(30)
    assert rig.balancer.fault.reason.startswith("cannot stand up")
    assert rig.robot.atmega.motors == (0.0, 0.0)


@pytest.mark.parametrize("seed", range(3))
def test_knocked_over_is_a_fault_and_a_command_brings_it_back(seed: int) -> None:
    rig = upright(seed=seed).run(2)
    rig.body.push(1.0)
    rig.run(3)
    assert (rig.balancer.mode, rig.balancer.fault) == ("fault", ("fell", "fell"))
    assert rig.robot.atmega.motors == (0.0, 0.0)
    rig.run(5)
    assert rig.balancer.mode == "fault"
    rig.balancer.command("stand", rig.now)
    rig.run(10)
    assert on_its_feet(rig)


def test_rest_lets_it_lie_and_stand_wakes_it() -> None:
    rig = upright()
    rig.body.push(0.02)  # the hand lets go
    rig.run(2)
    rig.balancer.command("rest", rig.now)
    rig.run(4)
    assert rig.balancer.mode == "idle"
    assert rig.robot.atmega.motors == (0.0, 0.0)
    assert abs(rig.body.tilt) > 1.5
    rig.balancer.command("stand", rig.now)
    rig.run(10)
    assert on_its_feet(rig)


def test_a_real_robot_waits_for_its_command() -> None:
    rig = Rig(start_mode="rest").run(10)
    assert rig.balancer.mode == "idle"
    assert rig.body.held


def test_stop_turns_the_motors_off_for_good() -> None:
    rig = upright().run(2)
    rig.balancer.stop("by hand")
    rig.run(3)
    assert rig.balancer.mode == "fault"
    assert rig.balancer.fault == ("stopped", "stopped: by hand")
    assert rig.robot.atmega.motors == (0.0, 0.0)


def test_stop_while_starting_holds_until_a_command() -> None:
    rig = Rig().run(0.5)
    rig.balancer.stop("early")
    rig.run(5)
    assert (rig.balancer.mode, rig.robot.atmega.motors) == ("fault", (0.0, 0.0))
    rig.balancer.command("stand", rig.now)
    rig.run(3)
    assert on_its_feet(rig)


def test_a_command_while_starting_is_remembered() -> None:
    rig = Rig(start_mode="rest").run(0.5)
    rig.balancer.command("stand", rig.now)
    assert rig.balancer.mode == "calibrating"
    assert on_its_feet(rig.run(5))


class Failing:
    """Stands between balancer and bus and fails for a number of transfers."""

    def __init__(self, rig: Rig, code: int = errno.EREMOTEIO) -> None:
        self.left = 0
        self.code = code
        for name in ("write", "read", "write_read"):
            setattr(rig.bus, name, self._wrapped(getattr(rig.bus, name)))

    def _wrapped(self, transfer):
        def attempt(*arguments):
            if self.left > 0:
                self.left -= 1
                raise OSError(self.code, "Remote I/O error")
            return transfer(*arguments)

        return attempt


def test_single_bus_errors_are_borne_with_the_last_command_held() -> None:
    rig = upright().run(2)
    failing = Failing(rig)
    for _ in range(100):
        failing.left = TOLERATED_ERRORS - 1
        rig.run(0.2)
    assert on_its_feet(rig)
    assert rig.balancer.bus_errors == 100 * (TOLERATED_ERRORS - 1)


def test_a_dead_bus_is_a_fault_and_recovery_is_explicit() -> None:
    rig = upright().run(2)
    failing = Failing(rig, errno.ETIMEDOUT)
    failing.left = 10**9
    rig.run(3)
    assert rig.balancer.mode == "fault"
    assert rig.balancer.fault == ("bus", "I2C, ATmega: Remote I/O error (error 110)")
    failing.left = 0
    rig.run(2 * RETRY_S)
    assert rig.robot.atmega.motors == (0.0, 0.0)
    assert rig.balancer.mode == "fault"
    rig.balancer.command("stand", rig.now)
    assert on_its_feet(rig.run(10))


def test_motors_run_no_longer_than_the_watchdog_when_the_bus_dies() -> None:
    rig = upright().run(2)
    rig.body.push(0.1)
    rig.run(0.02)
    Failing(rig).left = 10**9
    died = rig.now
    rig.run(1.0)
    rig.robot.atmega.advance(rig.now)
    assert rig.robot.atmega.motors == (0.0, 0.0)
    assert rig.robot.atmega._motors_until < died + balboa.MOTOR_TIMEOUT_S + 0.02


def test_an_imu_that_was_reset_is_set_up_again() -> None:
    rig = upright().run(2)
    rig.robot.imu.reset()
    rig.run(3)
    assert rig.balancer.fault == ("device", "IMU: no data, it was reset")
    rig.balancer.command("stand", rig.now)
    assert on_its_feet(rig.run(10))


def test_devices_that_come_late_are_waited_for() -> None:
    rig = Rig()
    failing = Failing(rig)
    failing.left = 10**9
    rig.run(2)
    assert rig.balancer.mode == "fault"
    assert not rig.balancer.ready
    failing.left = 0
    assert on_its_feet(rig.run(5))


def test_a_wrong_imu_keeps_the_robot_at_rest() -> None:
    rig = Rig()
    rig.robot.imu._registers[imu.WHO_AM_I] = 0x6A
    rig.run(2)
    assert rig.balancer.fault.reason.startswith("IMU at 0x6B: WHO_AM_I is 0x6A")
    assert rig.body.held


def test_the_same_seed_gives_the_same_run() -> None:
    first, second = (upright(seed=5).run(10) for _ in range(2))
    assert (first.body.x, first.body.tilt, first.balancer.duty) == (
        second.body.x,
        second.body.tilt,
        second.balancer.duty,
    )


def test_a_robot_with_a_motor_wired_the_other_way_round_stands_once_the_config_says_so() -> None:
    rig = Rig(flip_left_motor=True)
    rig.robot.miswire("left-motor", back=False)
    rig.run(8.0)
    assert (rig.balancer.mode, rig.balancer.fault) == ("balancing", None)
    assert abs(rig.body.tilt) < 0.1
