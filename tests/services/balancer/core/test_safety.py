"""What ends it, and how one gets out again: faults, battery, parameters, LEDs, refused commands."""

import math

import pytest
from balancer_rig import CONFIGURED, Rig, upright
from hypothesis import given
from hypothesis import strategies as st

from services.balancer.balancer import WISH_S
from services.balancer.core import faults
from services.balancer.core.control.controller import FALLEN, FALLEN_TICKS, STUCK_TICKS
from services.balancer.core.devices import imu
from services.balancer.core.devices.battery import EMPTY, LOW, OK, UNKNOWN, WINDOW_S, BatteryGuard
from services.balancer.core.devices.leds import CLAIM_S, shown
from sim.core.balboa import REST_TILT
from swarm.errors import LocalError
from swarm.messages import SetLeds

TIRED, FULL = 5.9, 7.4


def set_battery(rig: Rig, volts: float) -> None:
    rig.balancer.battery = volts


def run_watched(rig: Rig, seconds: int) -> Rig:
    """As the loop does it: the battery, which was read meanwhile, is judged once a second."""
    for _ in range(seconds):
        rig.balancer.watch_battery(rig.now)
        rig.run(1.0)
    return rig


def test_every_fault_says_how_to_recover() -> None:
    names = {value for name, value in vars(faults).items() if name.isupper() and isinstance(value, str)}
    assert names == set(faults.RECOVERY)


# Battery


def test_a_weak_battery_is_told_and_an_empty_one_lays_the_robot_down() -> None:
    rig = upright()
    run_watched(rig, 15)
    assert rig.balancer.battery_level == OK
    set_battery(rig, 6.5)
    run_watched(rig, 13)
    assert rig.balancer.battery_level == LOW
    assert rig.balancer.notices.pop() == ("battery", "low: 6.5 V, the robot lies down at 6.0 V")
    assert rig.balancer.mode == "balancing"
    set_battery(rig, TIRED)
    run_watched(rig, 11)
    rig.run(3)
    assert (rig.balancer.mode, rig.balancer.posture) == ("fault", "front")
    assert rig.balancer.fault == ("battery", "battery empty: 5.9 V")
    assert rig.robot.atmega.motors == (0.0, 0.0)
    with pytest.raises(LocalError, match=r"mode stand: battery empty: 5\.9 V: charge or change"):
        rig.balancer.command("stand", rig.now)
    set_battery(rig, FULL)
    run_watched(rig, 13)
    assert rig.balancer.mode == "fault", "no fault goes by itself"
    rig.balancer.command("stand", rig.now)
    rig.run(8)
    assert rig.balancer.mode == "balancing"


def test_a_robot_whose_battery_is_not_read_any_more_lies_down_and_stands_again_when_it_is() -> None:
    rig = upright()
    run_watched(rig, 15)
    rig.balancer.battery = None
    run_watched(rig, 4)
    assert (rig.balancer.mode, rig.balancer.posture) == ("fault", "front")
    assert rig.balancer.fault == ("bus", "the battery's voltage was not read for 60 s")
    assert (rig.balancer.battery_level, rig.balancer.battery_time_left) == (UNKNOWN, None)
    with pytest.raises(LocalError, match="mode stand: the battery's voltage was not read"):
        rig.balancer.command("stand", rig.now)
    set_battery(rig, FULL)
    run_watched(rig, 1)
    rig.balancer.command("stand", rig.now)


def test_a_battery_that_was_never_read_is_not_judged() -> None:
    guard = BatteryGuard(6.6, 6.0)
    assert not guard.update(None, 100.0)
    assert guard.level == OK


def test_a_dip_under_load_is_no_empty_battery() -> None:
    rig = upright()
    run_watched(rig, 12)
    for _ in range(5):
        set_battery(rig, 5.0)
        run_watched(rig, 8)
        set_battery(rig, FULL)
        run_watched(rig, 1)
    assert rig.balancer.battery_level == OK
    assert rig.balancer.mode == "balancing"


@pytest.mark.parametrize("limit", [7.8, 9.0])
def test_there_is_no_time_left_for_a_battery_whose_limit_is_above_six_full_cells(limit: float) -> None:
    guard = BatteryGuard(10.0, limit)
    guard.update(9.5, 0.0)
    assert guard.time_left(moving=True) is None


def test_time_left_as_the_thesis_reckons_it() -> None:
    """Full cells and motors running: 4.5 to 5 hours (thesis 2.4.1)."""
    guard = BatteryGuard(6.6, 6.0)
    assert guard.time_left(moving=True) is None
    guard.update(7.8, 0.0)
    assert 4.5 < guard.time_left(moving=True) / 3600 < 5.0
    assert guard.time_left(moving=False) > guard.time_left(moving=True)
    guard = BatteryGuard(6.6, 6.0)
    guard.update(5.0, 0.0)
    assert guard.time_left(moving=True) == 0.0


@given(st.lists(st.tuples(st.floats(0, 20), st.floats(0, 12)), max_size=60))
def test_the_guard_is_never_harder_than_its_best_reading(readings) -> None:
    guard, now = BatteryGuard(6.6, 6.0), 100.0
    for shift, volts in readings:
        now += shift
        guard.update(volts, now)
        if volts >= 6.7:
            assert guard.level == OK
        if guard.level == EMPTY:
            assert guard.volts < 6.1


def test_a_battery_is_better_only_from_a_tenth_of_a_volt_above_a_limit_on() -> None:
    guard, levels = BatteryGuard(6.6, 6.0), []
    for begin, volts in enumerate((5.9, 6.05, 6.15, 6.65, 6.75)):
        for second in range(12):
            guard.update(volts, 12.0 * begin + second)
        levels.append(guard.level)
    assert levels == [EMPTY, EMPTY, LOW, LOW, OK]


def test_a_clock_that_goes_back_begins_a_new_window() -> None:
    guard = BatteryGuard(6.6, 6.0)
    assert not any(guard.update(5.0, now) for now in (100.0, 105.0, 95.0, 104.0))
    assert guard.update(5.0, 105.0)


def test_the_guard_waits_for_a_whole_window() -> None:
    guard = BatteryGuard(6.6, 6.0)
    levels = [guard.update(5.0, float(second)) and guard.level for second in range(round(WINDOW_S) + 2)]
    assert levels == [False] * 10 + [EMPTY, False]


# Faults


@pytest.mark.parametrize("command", ["stand", "rest"])
def test_a_fault_is_left_by_a_command_only(command: str) -> None:
    rig = upright().run(2)
    rig.balancer.stop("enough")
    assert not rig.balancer.stop("again")
    rig.run(5)
    assert rig.balancer.fault == ("stopped", "stopped: enough")
    for refused in ("lie", "calibrate"):
        with pytest.raises(LocalError):
            rig.balancer.command(refused, rig.now)
    assert rig.balancer.mode == "fault"
    rig.balancer.command(command, rig.now)
    assert rig.balancer.fault is None


def test_stand_is_refused_while_the_devices_are_silent_and_not_kept_for_later() -> None:
    rig = upright().run(2)
    read = rig.bus.read
    rig.bus.read = lambda address, count: (_ for _ in ()).throw(OSError(121, "Remote I/O error"))
    rig.run(2)
    with pytest.raises(LocalError, match="devices do not answer"):
        rig.balancer.command("stand", rig.now)
    rig.bus.read = read
    rig.run(5)
    assert (rig.balancer.mode, rig.balancer.duty) == ("fault", (0.0, 0.0))
    rig.balancer.command("stand", rig.now)
    assert rig.run(8).balancer.mode == "balancing"


def test_a_bus_that_fails_before_the_zero_is_found_voids_the_command_to_stand() -> None:
    rig = Rig(start_mode="rest").run(0.5)
    rig.balancer.command("stand", rig.now)
    read = rig.bus.read
    rig.bus.read = lambda address, count: (_ for _ in ()).throw(OSError(121, "Remote I/O error"))
    rig.run(0.2)
    rig.bus.read = read
    rig.run(5)
    assert rig.balancer.ready
    assert (rig.balancer.mode, rig.balancer.fault.name, rig.balancer.duty) == ("fault", "bus", (0.0, 0.0))
    rig.balancer.command("stand", rig.now)
    assert rig.run(4).balancer.mode == "balancing"


def test_a_clock_that_stands_still_is_a_fault() -> None:
    rig = upright().run(2)
    frozen = rig.now
    for _ in range(STUCK_TICKS + 1):
        rig.balancer.step(frozen)
    assert rig.balancer.fault.name == "clock"
    assert rig.robot.atmega.motors == (0.0, 0.0)


@pytest.mark.parametrize("manoeuvre", ["stand", "lie"])
def test_a_clock_that_goes_back_ends_a_manoeuvre(manoeuvre: str) -> None:
    """Full power for 0.4 s may not become full power until the clock is there again."""
    if manoeuvre == "stand":
        rig = Rig(start_mode="rest", tilt=REST_TILT, held=False).run(4)
        rig.balancer.command("stand", rig.now)
        rig.run(0.5)
    else:
        rig = upright().run(2)
        rig.balancer.command("lie", rig.now)
        rig.run(0.05)
    assert rig.balancer.duty != (0.0, 0.0)
    rig.balancer.step(rig.now - 100.0)
    assert rig.balancer.fault.name == "clock"
    assert rig.robot.atmega.motors == (0.0, 0.0)


def test_a_clock_that_goes_back_makes_no_command_last_longer() -> None:
    rig = upright().run(2)
    rig.balancer.drive(0.3, 0.0, 5.0, rig.now)
    rig.run(1.5)
    assert rig.balancer.demand[0] == pytest.approx(0.3)
    rig.balancer.step(rig.now - 100.0)
    rig.run(2.0)
    assert rig.balancer.mode == "balancing"
    assert rig.balancer.demand == (0.0, 0.0)


def test_a_clock_that_jumps_ahead_makes_no_lurch() -> None:
    rig = upright().run(2)
    rig.now += 1000.0
    rig.body.now += 1000.0
    rig.deadline += 1000.0
    rig.run(5)
    assert rig.balancer.mode == "balancing"


@pytest.mark.parametrize("mode", ["fly", "", "balancing", "STAND"])
def test_an_unknown_mode_is_refused_and_changes_nothing(mode: str) -> None:
    rig = upright().run(1)
    with pytest.raises(LocalError, match="expected one of stand, rest, lie, calibrate"):
        rig.balancer.command(mode, rig.now)
    assert rig.balancer.mode == "balancing"


def test_a_mode_before_calibration_ends_is_kept_or_refused() -> None:
    rig = Rig(start_mode="rest").run(0.5)
    with pytest.raises(LocalError, match="this one is calibrating"):
        rig.balancer.command("calibrate", rig.now)
    rig.balancer.command("stand", rig.now)
    assert rig.run(4).balancer.mode == "balancing"


@pytest.mark.parametrize("controller", ["lqr", "pololu", "thesis"])
@pytest.mark.parametrize("stall", [0.25, 0.35, 0.4, 0.45, 0.49, 0.6])
def test_a_robot_that_falls_while_the_loop_stands_still_does_not_drive_on_the_floor(
    controller: str, stall: float
) -> None:
    """The ATmega stopped its motors meanwhile; the gyro's samples of the fall are missing."""
    rig = upright(controller=controller).run(2)
    rig.balancer.drive(0.4, 0.0, 9.0, rig.now)
    rig.run(1)
    stalled = rig.tick
    rig.lateness = lambda tick: stall if tick == stalled else 0.0
    on_the_floor = 0
    for _ in range(300):
        rig.run(0.01)
        on_the_floor += abs(rig.body.tilt) >= REST_TILT and rig.robot.atmega.motors != (0.0, 0.0)
    assert on_the_floor <= 2 * FALLEN_TICKS
    assert (rig.balancer.mode == "balancing") == (abs(rig.body.tilt) < FALLEN)


@pytest.mark.parametrize("order", ["stop", "rest"])
def test_a_stop_is_obeyed_in_its_tick_though_the_sensors_do_not_answer(order: str) -> None:
    """The command that holds through some failed ticks is that of a robot that balances."""
    rig = upright().run(1)
    rig.balancer.drive(0.3, 0.0, 9.0, rig.now)
    rig.run(1)
    del rig.robot.devices[imu.ADDRESS]
    rig.run(0.02)
    assert rig.robot.atmega.motors != (0.0, 0.0)
    assert rig.balancer.mode == "balancing"
    if order == "stop":
        rig.balancer.stop("enough")
    else:
        rig.balancer.command("rest", rig.now)
    rig.run(0.01)
    assert rig.robot.atmega.motors == (0.0, 0.0)


@pytest.mark.parametrize(
    "part", [slice(0, imu.BLOCK), slice(0, 6), slice(6, imu.BLOCK)], ids=["both", "gyro", "accelerometer"]
)
@pytest.mark.parametrize("speed", [0.0, 0.3])
def test_a_sensor_that_is_frozen_at_its_last_sample_stops_the_motors_before_the_robot_has_fallen(
    part: slice, speed: float
) -> None:
    rig = upright().run(1)
    rig.balancer.drive(speed, 0.0, 9.0, rig.now)
    rig.run(1)
    read, kept = rig.bus.write_read, bytearray()

    def frozen(address: int, data: bytes, count: int) -> bytes:
        block = bytearray(read(address, data, count))
        if address == imu.ADDRESS and count == imu.BLOCK:
            kept[:] = kept or block
            block[part] = kept[part]
        return bytes(block)

    rig.bus.write_read = frozen
    rig.run(0.12)
    assert rig.balancer.fault == ("device", "IMU: gyro or accelerometer is frozen: its samples bring nothing new")
    assert rig.robot.atmega.motors == (0.0, 0.0)
    assert abs(rig.body.tilt) < FALLEN
    rig.run(5)
    assert rig.robot.atmega.motors == (0.0, 0.0)
    rig.bus.write_read = read
    rig.run(2)
    assert (rig.balancer.mode, rig.balancer.duty) == ("fault", (0.0, 0.0)), "no fault goes by itself"
    rig.balancer.command("stand", rig.now)
    assert rig.run(8).balancer.mode == "balancing"


# Parameters at run time


def test_parameters_change_while_it_balances() -> None:
    rig = upright().run(2)
    gains = dict(rig.balancer.parameters)
    rig.balancer.change({"k_tilt": gains["k_tilt"] * 1.2, "max_speed": 0.2, "trim": 0.02})
    rig.balancer.drive(0.5, 0.0, 5.0, rig.now)
    rig.run(3)
    assert rig.balancer.mode == "balancing"
    assert rig.balancer.demand[0] == pytest.approx(0.2)
    assert rig.balancer.parameters["k_tilt"] == gains["k_tilt"] * 1.2


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"k_nonsense": 1.0}, "parameter 'k_nonsense': unknown, there are acceleration, "),
        ({"k_tilt": 1e9}, r"parameter k_tilt: expected .* got 1e\+09"),
        ({"k_tilt": -1.0}, "parameter k_tilt: expected"),
        ({"max_speed": 0.6}, "parameter max_speed: expected 0 to 0.5, got 0.6"),
        ({"trim": math.nan}, "parameter trim: expected -0.5 to 0.5, got nan"),
        ({"trim": 0.1, "angle_response": 7.0}, "parameter 'angle_response': unknown"),
    ],
)
def test_a_parameter_that_cannot_be_is_refused_with_all_of_its_message(values, message: str) -> None:
    rig = upright().run(1)
    before = dict(rig.balancer.parameters)
    with pytest.raises(LocalError, match=message):
        rig.balancer.change(values)
    assert rig.balancer.parameters == before


def test_each_controller_has_its_own_parameters() -> None:
    rig = upright(controller="pololu").run(1)
    rig.balancer.change({"angle_response": 12.0, "distance_response": 90.0})
    assert rig.run(10).balancer.mode == "balancing"
    with pytest.raises(LocalError, match="unknown"):
        rig.balancer.change({"k_tilt": 1.0})


# LEDs


def lamps(mode: str, *, fault: str = "", claim=None, low: bool = False) -> list:
    """What is to be seen in two seconds, without repetitions."""
    seen = []
    for tick in range(200):
        now = shown(mode, fault, claim, low_battery=low, now=100.0 + tick * 0.01)
        if not seen or seen[-1] != now:
            seen.append(now)
    return seen


OFF, RED, YELLOW, GREEN, BOTH = (
    (False, False, False),
    (True, False, False),
    (False, True, False),
    (False, False, True),
    (True, True, False),
)


def test_the_language_of_the_lamps() -> None:
    assert lamps("idle") == [OFF]
    assert lamps("starting") == lamps("standing_up") == lamps("lying_down") == [YELLOW]
    assert lamps("calibrating") == [YELLOW, OFF] * 4
    assert lamps("balancing") == [GREEN]
    assert lamps("fault", fault="fell") == [RED]
    assert lamps("fault", fault="stopped") == [BOTH]


def test_an_app_has_the_lamps_but_for_faults_and_the_battery() -> None:
    assert lamps("balancing", claim=YELLOW) == [YELLOW]
    assert lamps("fault", fault="fell", claim=GREEN) == [RED]
    assert lamps("balancing", low=True) == [(True, False, True), GREEN]
    assert lamps("balancing", claim=OFF, low=True) == [RED, OFF]


def test_lamps_follow_mode_claim_and_its_end() -> None:
    rig = upright(held=True).run(0.1)
    assert rig.robot.atmega.leds == GREEN
    rig.balancer.claim_leds(BOTH, CLAIM_S, rig.now)
    rig.run(CLAIM_S - 0.05)
    assert rig.robot.atmega.leds == BOTH
    rig.run(0.1)
    assert rig.robot.atmega.leds == GREEN
    rig.balancer.claim_leds(BOTH, 60.0, rig.now)
    rig.run(0.1)
    rig.balancer.command("stand", rig.now)
    rig.run(0.1)
    assert rig.robot.atmega.leds == GREEN
    rig.balancer.claim_leds(BOTH, 60.0, rig.now)
    rig.balancer.stop("x")
    assert rig.run(0.1).robot.atmega.leds == BOTH
    for seconds in (0.0, -1.0, 61.0, math.nan):
        with pytest.raises(LocalError, match="leds: seconds"):
            rig.balancer.claim_leds(RED, seconds, rig.now)


def test_a_claim_without_a_time_lasts_as_the_original_lamps_did() -> None:
    assert SetLeds(True, False, False).seconds == CLAIM_S


def test_a_lying_robot_says_so_and_not_that_it_stands() -> None:
    rig = Rig(CONFIGURED, start_mode="rest", tilt=-REST_TILT, held=False).run(4)
    assert rig.robot.atmega.leds == OFF
    assert rig.balancer.posture == "back"


# What others command, and what a person does with the robot


@pytest.mark.parametrize("controller", ["lqr", "pololu", "thesis"])
def test_a_robot_that_is_lifted_switches_its_motors_off_under_each_controller(controller: str) -> None:
    rig = upright(controller=controller).run(2)
    rig.body.lift(0.05, 0.0)
    rig.run(5)
    assert rig.balancer.fault is not None
    assert rig.balancer.fault.name in ("lifted", "fell")
    assert rig.robot.atmega.motors == (0.0, 0.0)


def test_a_stop_is_known_until_a_command_to_move_is_obeyed_whatever_the_fault() -> None:
    rig = upright().run(1)
    rig.body.push(0.5)
    rig.run(3)
    assert rig.balancer.fault.name in ("fell", "cannot_stand")
    assert not rig.balancer.stop("enough")  # the robot does not move already
    assert rig.balancer.stopped
    rig.balancer.command("rest", rig.now)
    assert rig.balancer.stopped
    rig.balancer.command("stand", rig.now)
    assert not rig.balancer.stopped


def test_a_command_to_stand_is_given_up_where_the_robot_is_carried_for_long() -> None:
    rig = Rig(start_mode="rest", held=True)
    zero = rig.balancer._seek_zero
    rig.balancer._seek_zero = lambda *_: None  # it is carried
    rig.run(0.5)
    rig.balancer.command("stand", rig.now)
    rig.run(WISH_S + 1.0)
    rig.balancer._seek_zero = zero
    rig.run(4)
    assert rig.balancer.ready
    assert rig.balancer.mode == "idle"
    assert any("given up" in text for _, text in rig.balancer.notices)


def test_a_limit_that_becomes_narrower_binds_the_command_in_force() -> None:
    rig = upright().run(1)
    rig.balancer.drive(0.5, 0.0, 10.0, rig.now)
    rig.run(3)
    rig.balancer.change({"max_speed": 0.1})
    rig.run(2)
    assert rig.balancer.demand[0] == pytest.approx(0.1)


def test_to_lie_down_again_does_not_hide_that_the_battery_is_empty() -> None:
    rig = upright().run(1)
    set_battery(rig, TIRED - 0.3)
    for _ in range(100):
        rig.balancer.watch_battery(rig.now)
        rig.run(1.0, until=lambda rig: rig.balancer.mode == "lying_down")
        if rig.balancer.mode == "lying_down":
            break
    rig.balancer.command("lie", rig.now)
    rig.run(3)
    assert rig.balancer.fault is not None
    assert rig.balancer.fault.name == "battery"
