"""Driving in the simulated body: velocity commands, heading, what ends them."""

import math

import pytest
from balancer_rig import CONFIGURED, OTHER, Rig, scaled, upright
from conftest import thinned
from hypothesis import given
from hypothesis import strategies as st

from services.balancer.core.control.drive import HEADING_LAG, TURN_LIMIT, WAY_LAG, Drive, DriveLimits
from swarm.errors import LocalError

BODIES = pytest.mark.parametrize("plant", [CONFIGURED, OTHER], ids=["configured", "other"])


def driving(rig: Rig, speed: float, turn_rate: float, seconds: float) -> Rig:
    """Drive as an app does: a command ten times a second that holds for half a second; then wait for the end."""
    for _ in range(round(seconds * 10)):
        rig.balancer.drive(speed, turn_rate, 0.5, rig.now)
        rig.run(0.1)
    rig.balancer.drive(0.0, 0.0, 0.5, rig.now)
    return rig


@BODIES
@pytest.mark.parametrize("speed", [0.2, -0.2, 0.5])
def test_a_robot_tracks_a_commanded_speed(plant, speed: float) -> None:
    rig = upright(plant=plant).run(3)
    start = rig.body.x
    driving(rig, speed, 0.0, 4.0)
    before, then = rig.body.x, rig.now
    driving(rig, speed, 0.0, 4.0)
    assert (rig.body.x - before) / (rig.now - then) == pytest.approx(speed, rel=0.05)
    assert abs(rig.body.y) < 0.01
    rig.run(6)
    assert rig.body.x - start == pytest.approx(8 * speed, abs=0.05)
    assert abs(rig.body.speed) < 0.1
    assert rig.balancer.mode == "balancing"


@BODIES
@pytest.mark.parametrize("turn_rate", [0.5, -2.0, 3.0])
def test_a_robot_turns_on_the_spot(plant, turn_rate: float) -> None:
    rig = upright(plant=plant).run(3)
    driving(rig, 0.0, turn_rate, 4.0).run(3)
    assert rig.body.heading == pytest.approx(4 * turn_rate, abs=math.radians(2))
    assert math.hypot(rig.body.x, rig.body.y) < 0.1


@BODIES
def test_a_square_ends_where_it_began(plant) -> None:
    rig = upright(plant=plant, place=(1.0, 2.0, 0.5)).run(3)
    corners = []
    for _ in range(4):
        driving(rig, 0.2, 0.0, 2.5).run(2.5)
        corners.append((rig.body.x, rig.body.y))
        driving(rig, 0.0, math.pi / 2, 1.0).run(2.0)
    assert rig.balancer.mode == "balancing"
    sides = [math.dist(a, b) for a, b in zip([(1.0, 2.0), *corners], corners, strict=False)]
    assert sides == pytest.approx([0.5] * 4, abs=0.06)
    assert (rig.body.x, rig.body.y) == pytest.approx((1.0, 2.0), abs=0.06)
    assert rig.body.heading - 0.5 == pytest.approx(math.tau, abs=math.radians(3))
    # What it believes is what it did.
    estimate = rig.balancer.estimate
    assert math.dist((estimate.x, estimate.y), (0.0, 0.0)) == pytest.approx(
        math.dist((rig.body.x, rig.body.y), (1.0, 2.0)), abs=0.03
    )
    assert estimate.heading == pytest.approx(rig.body.heading - 0.5, abs=math.radians(2))


@BODIES
def test_pushes_while_it_drives_change_neither_way_nor_heading(plant) -> None:
    rig = upright(plant=plant).run(3)
    start = rig.body.x
    for push in (0.1, -0.1, 0.1, -0.1):
        rig.body.push(push)
        rig.body.turn_rate += 3.0
        driving(rig, 0.2, 0.0, 3.0)
    rig.run(5)
    assert rig.balancer.mode == "balancing"
    assert rig.body.x - start == pytest.approx(2.4, abs=0.1)
    assert rig.body.heading == pytest.approx(0.0, abs=math.radians(3))


@pytest.mark.slow
def test_heading_is_held_for_minutes_with_unlike_motors() -> None:
    """A motor that is a tenth weaker, and wheels of which one slips now and then."""
    rig = upright().run(3)
    weak, drive = 0.9, rig.body.drive
    rig.body.drive = lambda left, right: drive(weak * left, right)
    for _ in range(12):
        driving(rig, 0.2, 0.0, 5.0)
        driving(rig, -0.2, 0.0, 5.0)
    rig.run(3)
    assert rig.body.heading == pytest.approx(0.0, abs=math.radians(3))


@BODIES
def test_a_weaker_motor_does_not_turn_it_while_it_drives(plant) -> None:
    rig = upright(plant=plant).run(3)
    drive = rig.body.drive
    rig.body.drive = lambda left, right: drive(0.9 * left, right)
    driving(rig, 0.5, 0.0, 3.0)
    assert rig.body.heading == pytest.approx(0.0, abs=math.radians(1.5))


@pytest.mark.parametrize(("plant", "lag"), [(CONFIGURED, 0.06), (OTHER, 0.2)], ids=["configured", "other"])
def test_a_robot_keeps_up_with_a_place_that_speeds_up_and_slows_down(plant, lag: float) -> None:
    """Feed-forward of lean and duty: without the lean it lags by 15 and 24 cm."""
    rig = upright(plant=plant).run(3)
    drive, lags = rig.balancer._controller._drive, []
    rig.balancer.drive(0.5, 0.0, 3.0, rig.now)
    rig.run(6, until=lambda rig: lags.append(abs(rig.body.travel - drive.way)))
    assert max(lags) < lag


def test_a_command_that_is_not_renewed_runs_out() -> None:
    rig = upright().run(3)
    rig.balancer.drive(0.3, 1.0, 1.0, rig.now)
    rig.run(0.9)
    assert rig.balancer.demand == pytest.approx((0.3, 1.0))
    rig.run(1.0)
    assert rig.balancer.demand == (0.0, 0.0)
    place = rig.body.x
    rig.run(10)
    assert rig.balancer.mode == "balancing"
    assert math.hypot(rig.body.x - place, 0) < 0.25
    assert abs(rig.body.speed) < 0.1


def test_speed_changes_no_faster_than_the_limits() -> None:
    rig = upright(acceleration=0.4, turn_acceleration=2.0).run(3)
    rig.balancer.drive(0.5, 3.0, 5.0, rig.now)
    last = rig.balancer.demand
    for _ in range(100):
        rig.run(0.01)
        speed, turn_rate = rig.balancer.demand
        assert abs(speed - last[0]) <= 0.4 * 0.0101 + 1e-9
        assert abs(turn_rate - last[1]) <= 2.0 * 0.0101 + 1e-9
        last = speed, turn_rate


def test_what_is_above_the_limit_is_cut_and_told() -> None:
    rig = upright(max_speed=0.3).run(3)
    rig.balancer.drive(0.2, 0.0, 1.0, rig.now)
    assert not rig.balancer.notices
    rig.balancer.drive(-9.0, 99.0, 3.0, rig.now)
    assert list(rig.balancer.notices) == [
        ("velocity", "speed -9 is above the limit of 0.3 m/s, turn rate 99 is above the limit of 3 rad/s")
    ]
    rig.run(2.5)
    assert rig.balancer.demand == pytest.approx((-0.3, 3.0))


@pytest.mark.parametrize(
    ("speed", "turn_rate", "seconds", "message"),
    [
        (math.nan, 0.0, 1.0, "not finite"),
        (0.0, math.inf, 1.0, "not finite"),
        (0.1, 0.0, 0.0, "above 0 up to 10 s, got 0"),
        (0.1, 0.0, -1.0, "above 0 up to 10 s, got -1"),
        (0.1, 0.0, math.nan, "got nan"),
        (0.1, 0.0, 11.0, "got 11"),
    ],
)
def test_a_command_that_is_none_is_refused(speed: float, turn_rate: float, seconds: float, message: str) -> None:
    rig = upright().run(1)
    with pytest.raises(LocalError, match=message):
        rig.balancer.drive(speed, turn_rate, seconds, rig.now)
    assert rig.run(1).balancer.demand == (0.0, 0.0)


def test_a_robot_that_does_not_balance_does_not_drive() -> None:
    rig = Rig(start_mode="rest").run(4)
    with pytest.raises(LocalError, match="only a balancing robot drives, this one is idle"):
        rig.balancer.drive(0.1, 0.0, 1.0, rig.now)


def test_a_command_of_before_a_fall_is_void_after_it() -> None:
    rig = upright().run(2)
    rig.balancer.drive(0.3, 0.0, 10.0, rig.now)
    rig.body.push(1.0)
    rig.run(2)
    assert rig.balancer.fault.name == "fell"
    rig.balancer.command("stand", rig.now)
    rig.run(4, until=lambda rig: rig.balancer.mode == "balancing")
    rig.run(1)
    assert rig.balancer.demand == (0.0, 0.0)


def test_held_while_it_drives_it_does_not_run_away_afterwards() -> None:
    """Its wheels are blocked: the place waits for it."""
    drive = Drive(CONFIGURED, DriveLimits(0.5, 3.0, 0.5, 6.0))
    drive.begin(1.0, 0.0)
    drive.command(0.5, 3.0, 10.0)
    for tick in range(500):
        drive.step(1.0, 0.0, tick * 0.01, 0.01)
    assert drive.way == pytest.approx(1.0 + WAY_LAG)
    assert drive.heading == pytest.approx(HEADING_LAG)


def test_carried_off_while_it_stands_it_goes_back() -> None:
    drive = Drive(CONFIGURED, DriveLimits(0.5, 3.0, 0.5, 6.0))
    drive.begin(1.0, 0.0)
    for tick in range(500):
        drive.step(3.0, 2.0, tick * 0.01, 0.01)
    assert (drive.way, drive.heading) == (1.0, 0.0)
    assert drive.turn(2.0, 0.01) == -TURN_LIMIT


@given(st.lists(st.tuples(*[st.floats(-1e6, 1e6)] * 4, st.floats(0.0, 1.0)), max_size=30))
def test_whatever_is_commanded_limits_hold(commands) -> None:
    limits = DriveLimits(0.5, 3.0, 0.5, 6.0)
    drive, now = Drive(CONFIGURED, limits), 0.0
    drive.begin(0.0, 0.0)
    for speed, turn_rate, way, heading, dt in commands:
        now += dt
        drive.command(speed, turn_rate, now + 0.3)
        drive.step(way, heading, now, dt)
        assert abs(drive.speed) <= limits.speed * (1 + 1e-9)
        assert abs(drive.turn_rate) <= limits.turn_rate * (1 + 1e-9)
        assert abs(drive.turn(heading, dt)) <= TURN_LIMIT
        assert abs(drive.demand.acceleration) <= limits.acceleration * (1 + 1e-9)


@pytest.mark.parametrize("name", thinned(["mass", "lever", "inertia", "stall_torque", "free_speed"]))
@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_the_balancer_drives_a_body_that_is_a_fifth_off(name: str, factor: float) -> None:
    rig = upright(plant=scaled(CONFIGURED, name, factor)).run(2)
    driving(rig, 0.5, 1.0, 4.0).run(5)
    assert rig.balancer.mode == "balancing"
    assert rig.worst_tilt < math.radians(25)
    assert rig.body.heading == pytest.approx(4.0, abs=math.radians(4))
