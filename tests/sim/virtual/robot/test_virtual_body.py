"""The body without physics: limits, ramps, postures and sensors, as the balancer's own."""

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.virtual.robot.body import (
    BALANCING,
    DIFFERENTIAL,
    FALL_WAY,
    FAULT,
    IDLE,
    LIE_DOWN,
    MODELS,
    POINT,
    RISE_WAY,
    STAND_UP,
    STANDING,
    VirtualBody,
)
from swarm.config.types import Balancing, Body
from swarm.errors import LocalError

LIMITS = Balancing()


def body_of(model=DIFFERENTIAL, place=(0.0, 0.0, 0.0), seed=1):
    return VirtualBody(model, Body(), LIMITS, place, random.Random(seed).gauss)


COMMANDS = st.lists(
    st.tuples(
        st.floats(0.0, 2.0),
        st.floats(-1.0, 1.0),
        st.floats(-5.0, 5.0),
        st.floats(0.02, 2.0),
    ),
    max_size=8,
)


@given(COMMANDS)
def test_speed_and_turn_rate_keep_to_limits_and_ramps(commands):
    body, now = body_of(), 0.0
    before = (0.0, 0.0)
    for gap, speed, turn, seconds in commands:
        for _ in range(round(gap / 0.01)):
            now += 0.01
            x, y = body.x, body.y
            body.advance(now)
            demand = body.demand
            assert abs(demand[0]) <= LIMITS.max_speed + 1e-9
            assert abs(demand[1]) <= LIMITS.max_turn_rate + 1e-9
            # steps of the body's own do not begin at ours: two of them may fall into one
            assert abs(demand[0] - before[0]) <= 2 * 0.01 * LIMITS.acceleration + 1e-9
            assert abs(demand[1] - before[1]) <= 2 * 0.01 * LIMITS.turn_acceleration + 1e-9
            assert math.hypot(body.x - x, body.y - y) <= 0.01 * LIMITS.max_speed + 1e-9
            before = demand
        body.drive(speed, turn, seconds, now)
    body.advance(now + 10.0)
    assert body.demand == (0.0, 0.0)
    at = (body.x, body.y, body.heading)
    body.advance(now + 99.0)
    assert (body.x, body.y, body.heading) == at


@given(COMMANDS, st.sampled_from(MODELS), st.booleans())
def test_how_often_one_looks_changes_no_bit(commands, model, lies):
    def end(step):
        body, now = body_of(model), 0.0
        for gap, speed, turn, seconds in commands:
            looks = round(gap / step)
            for look in range(looks):
                body.odometry(now + gap * look / looks)
            now += gap
            if body.mode == BALANCING:
                body.drive(speed, turn, seconds, now)
        if lies:
            body.push(1.0, now + 0.3)
            body.command("stand", now + 1.234)
        told = body.odometry(now + 7.0)
        return body.x, body.y, body.heading, told.x, told.y, told.gyro_heading, body.mode

    assert end(0.5) == end(0.037)


def test_a_point_follows_at_once_and_knows_its_way_exactly():
    body = body_of(POINT)
    body.drive(0.2, 0.0, 2.0, 0.0)
    told = body.odometry(5.0)
    assert body.x == pytest.approx(0.4, abs=0.003)
    assert told.x == body.x
    assert 0.5 * (told.left + told.right) == pytest.approx(body.x)
    body.drive(0.0, 1.0, 1.0, 5.0)
    assert body.odometry(9.0).gyro_heading == body.heading == pytest.approx(1.0, abs=0.015)


def test_a_cart_rolls_out_and_its_sensors_err():
    body = body_of()
    body.drive(0.3, 0.0, 2.0, 0.0)
    told = body.odometry(20.0)
    assert body.x == pytest.approx(0.6, abs=0.01)  # what it lacks at the start it rolls at the end
    assert told.x != body.x
    assert told.x == pytest.approx(body.x, rel=0.02)
    assert 0.0 < abs(told.gyro_heading) < 0.02
    assert body.demand == (0.0, 0.0)


def test_a_virtual_body_lies_down_and_gets_up_in_the_time_that_takes():
    body = body_of()
    body.command("lie", 1.0)
    with pytest.raises(LocalError, match="only a balancing robot drives"):
        body.drive(0.1, 0.0, 1.0, 1.1)
    body.advance(1.0 + LIE_DOWN)
    assert (body.mode, body.posture) == (IDLE, "front")
    assert body.x == pytest.approx(FALL_WAY)
    body.command("stand", 3.0)
    assert body.mode == STANDING
    assert body.next_change == 3.0 + STAND_UP
    body.advance(body.next_change)
    assert (body.mode, body.posture) == (BALANCING, "upright")
    assert body.x == pytest.approx(FALL_WAY - RISE_WAY)
    body.lay("back", 5.0)
    body.command("stand", 5.0)
    body.advance(9.0)
    assert body.x == pytest.approx(FALL_WAY)


def test_a_stop_makes_it_fall_until_it_is_told_to_stand():
    body = body_of()
    body.drive(0.3, 0.0, 9.0, 0.0)
    body.stop("enough", 1.0)
    assert (body.mode, body.posture, body.fault) == (FAULT, "front", "enough")
    at = body.x
    body.advance(3.0)
    assert body.x == at
    body.command("stand", 3.0)
    body.advance(5.0)
    assert (body.mode, body.fault) == (BALANCING, "")


@pytest.mark.parametrize(
    ("mode", "words"), [("lie", "only a balancing"), ("calibrate", "must be idle"), ("dance", "expected one of")]
)
def test_what_cannot_be_now_is_refused(mode, words):
    body = body_of()
    if mode == "lie":
        body.command("rest", 0.0)
    with pytest.raises(LocalError, match=words):
        body.command(mode, 1.0)


@pytest.mark.parametrize("drive", [(math.nan, 0.0, 1.0), (0.1, 0.1, 0.0), (0.1, 0.1, 11.0)])
def test_a_drive_that_is_none_is_refused(drive):
    with pytest.raises(LocalError):
        body_of().drive(*drive, 0.0)


@pytest.mark.parametrize("model", MODELS)
def test_the_seed_decides_what_the_sensors_say(model):
    def told(seed):
        body = body_of(model, seed=seed)
        body.drive(0.2, 0.3, 5.0, 0.0)
        return body.odometry(7.0)

    assert told(1) == told(1)
    assert (told(1) == told(2)) == (model == POINT)
