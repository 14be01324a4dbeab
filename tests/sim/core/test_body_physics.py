"""The simulated body: falls, lies, conserves energy, turns, and cannot be paused."""

import math
from dataclasses import replace

import pytest
from balancer_rig import CONFIGURED, OTHER
from conftest import costly
from hypothesis import given
from hypothesis import strategies as st

from services.balancer.core.control.body import GRAVITY
from sim.core.balboa import LONGEST_S, REST_TILT, BalboaBody


def test_a_held_body_stays_until_its_motors_start() -> None:
    body = BalboaBody(CONFIGURED, 0.0, tilt=0.1)
    body.advance(5.0)
    assert (body.tilt, body.x) == (0.1, 0.0)
    body.drive(0.0, 0.0)
    assert body.held
    body.drive(0.1, 0.1)
    body.advance(5.1)
    assert not body.held
    assert body.tilt != 0.1


@pytest.mark.parametrize("side", [1, -1])
def test_a_body_left_alone_falls_and_rests(side: int) -> None:
    body = BalboaBody(CONFIGURED, 0.0, tilt=side * 0.05, held=False)
    for step in range(200):
        body.advance(step * 0.01)
    assert body.tilt == side * REST_TILT
    assert body.tilt_rate == 0.0
    assert abs(body.speed) < 0.01


def test_a_starved_balancer_finds_it_on_the_floor() -> None:
    body = BalboaBody(CONFIGURED, 0.0, tilt=1e-9, held=False)
    body.advance(3600.0)
    assert body.tilt == REST_TILT
    assert body.now == pytest.approx(3600.0, abs=0.01)


def test_one_look_or_many_makes_no_difference() -> None:
    once, often = (BalboaBody(CONFIGURED, 0.0, tilt=0.1, held=False) for _ in range(2))
    once.advance(0.3)
    for step in range(1, 61):
        often.advance(step * 0.005)
    assert often.tilt == pytest.approx(once.tilt, rel=1e-2)


def test_time_does_not_run_backwards() -> None:
    body = BalboaBody(CONFIGURED, 5.0, tilt=0.1, held=False)
    body.advance(4.0)
    assert body.now == 5.0
    assert body.tilt == 0.1


def test_energy_is_conserved_without_motors_and_friction() -> None:
    free = replace(CONFIGURED, friction=0.0, stall_torque=1e-12)
    body = BalboaBody(free, 0.0, tilt=0.3, held=False)

    def energy() -> float:
        m, lever = free.mass, free.lever
        wheels = free.wheel_mass + free.wheel_inertia / free.wheel_radius**2
        vx = body.speed + lever * math.cos(body.tilt) * body.tilt_rate
        vz = -lever * math.sin(body.tilt) * body.tilt_rate
        kinetic = wheels * body.speed**2 + m * (vx**2 + vz**2) + free.inertia * body.tilt_rate**2
        return kinetic / 2 + m * GRAVITY * lever * math.cos(body.tilt)

    start = energy()
    body.advance(0.12)
    assert 0.5 < abs(body.tilt) < REST_TILT
    assert energy() == pytest.approx(start, rel=0.01)


def test_friction_holds_a_wheel_that_is_pushed_less_than_it() -> None:
    model = replace(CONFIGURED, lever=0.0)  # no gravity on the tilt
    body = BalboaBody(model, 0.0, held=False)
    body.drive(0.9 * model.friction / model.stall_torque, 0.9 * model.friction / model.stall_torque)
    body.advance(0.5)
    assert body.travel == pytest.approx(0.0, abs=1e-9)


def test_a_body_drives_in_the_direction_of_its_heading() -> None:
    body = BalboaBody(CONFIGURED, 0.0, place=(1.0, 2.0, math.pi / 2), held=False)
    body.drive(0.2, 0.2)
    body.advance(0.1)
    assert body.x == pytest.approx(1.0)
    assert body.y > 2.0
    assert body.heading == math.pi / 2


def test_right_faster_than_left_turns_counter_clockwise() -> None:
    body = BalboaBody(CONFIGURED, 0.0, tilt=REST_TILT, held=False)
    body.drive(-0.2, 0.2)
    body.advance(0.5)
    assert body.heading > 0.5
    left, right = body.wheel_angles()
    assert right > 0 > left
    assert (right - left) * CONFIGURED.wheel_radius / CONFIGURED.track == pytest.approx(body.heading)


def test_a_push_moves_body_and_wheels_forward() -> None:
    body = BalboaBody(CONFIGURED, 0.0)
    body.push(0.05)
    assert not body.held
    assert body.speed > 0
    # Momentum: the wheels are not fixed to the floor's rotation, so rolling inertia counts as mass.
    total = CONFIGURED.mass + CONFIGURED.wheel_mass + CONFIGURED.wheel_inertia / CONFIGURED.wheel_radius**2
    momentum = total * body.speed + CONFIGURED.mass * CONFIGURED.lever * body.tilt_rate
    assert momentum == pytest.approx(0.05)


@costly(60)
@given(
    st.sampled_from([CONFIGURED, OTHER]),
    st.floats(-2, 2),
    st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0, LONGEST_S * 1.5)), max_size=6),
)
def test_whatever_the_motors_do_the_state_stays_finite(model, tilt, commands) -> None:
    body = BalboaBody(model, 0.0, tilt=max(-REST_TILT, min(REST_TILT, tilt)), held=False)
    for left, right, seconds in commands:
        body.drive(left, right)
        body.advance(body.now + seconds)
        assert abs(body.tilt) <= REST_TILT
        assert abs(body.speed) < 5.0
        assert all(map(math.isfinite, (body.x, body.y, body.heading, body.tilt_rate, body.acceleration)))
