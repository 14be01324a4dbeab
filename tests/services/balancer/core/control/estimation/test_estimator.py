"""Tilt, way and heading from sensor samples; the gyro's zero."""

import math

import pytest
from balancer_rig import CONFIGURED
from hypothesis import given
from hypothesis import strategies as st

from services.balancer.core.control.estimation.estimator import Estimator
from services.balancer.core.control.estimation.gyro import KEPT_CHECK_S, SETTLE_S, STILL_SAMPLES, GyroZero, Zero
from services.balancer.core.devices import imu
from swarm.errors import RemoteError

G = imu.STANDARD_GRAVITY
PER_METRE = CONFIGURED.counts_per_turn / (math.tau * CONFIGURED.wheel_radius)


def reading(tilt: float, rate: float = 0.0) -> imu.ImuReading:
    return imu.ImuReading(rate, G * math.cos(tilt), G * math.sin(tilt))


def wrapped(count: int) -> int:
    return (count + 0x8000) % 0x10000 - 0x8000


def test_gyro_zero_is_the_mean_after_settling() -> None:
    zero, now, found = GyroZero(), 50.0, None
    for tick in range(500):
        found = zero.add(reading(0.0, 0.3 if tick < 99 else 0.02 + 0.001 * (-1) ** tick), now)
        now += 0.01
        if found is not None:
            break
    assert found == pytest.approx(Zero(0.02), abs=1e-4)
    assert tick == pytest.approx(SETTLE_S * 100 + STILL_SAMPLES - 1, abs=1)
    assert zero.restarts == 0


def ticks_until_found(zero: GyroZero, sample: imu.ImuReading, shake: float = 0.0) -> tuple[int, Zero | None]:
    for tick in range(1000):
        moved = sample._replace(back_rate=sample.back_rate + shake * (-1) ** tick)
        if (found := zero.add(moved, 50.0 + tick * 0.01)) is not None:
            return tick, found
    return 1000, None


def test_a_kept_zero_is_taken_after_a_short_look() -> None:
    kept = Zero(0.02, -0.01, 0.03)
    at_rest = reading(0.0, 0.021)._replace(up_rate=-0.01, back_rate=0.03)
    assert ticks_until_found(GyroZero(kept=kept), at_rest) == (round(KEPT_CHECK_S * 100), kept)
    # Nothing is to be learned from a robot that moves: what was right a second ago is right now.
    assert ticks_until_found(GyroZero(kept=kept), reading(0.3, -0.9), shake=0.5) == (round(KEPT_CHECK_S * 100), kept)


def test_a_kept_zero_that_is_wrong_is_found_out_at_rest() -> None:
    tick, found = ticks_until_found(GyroZero(kept=Zero(0.02)), reading(0.0, 0.05))
    assert found == pytest.approx(Zero(0.05))
    assert tick == pytest.approx(SETTLE_S * 100 + STILL_SAMPLES - 1, abs=1)


def test_a_robot_that_is_moved_begins_its_zero_anew() -> None:
    zero, now = GyroZero(), 0.0
    for tick in range(250):
        assert zero.add(reading(0.0)._replace(up_rate=0.5 if tick == 180 else 0.0), now) is None
        now += 0.01
    assert zero.restarts > 0
    assert any(zero.add(reading(0.0), now + tick * 0.01) == Zero(0.0) for tick in range(101))


@pytest.mark.parametrize("periods", [[0.01], [0.002, 0.018, 0.01, 0.15]])
def test_tilt_follows_the_gyro_with_the_time_that_passed(periods: list[float]) -> None:
    estimator = Estimator(CONFIGURED, Zero(0.05))
    now = tilt = 0.0
    estimator.update(reading(0.0, 0.05), (0, 0), now)
    for tick in range(40):
        dt = periods[tick % len(periods)]
        now, tilt = now + dt, tilt + 0.4 * dt
        # The wheels stand on the floor: they turn back against the body.
        count = wrapped(round(-tilt / math.tau * CONFIGURED.counts_per_turn))
        estimate = estimator.update(reading(tilt, 0.45), (count, count), now)
    assert estimate.tilt == pytest.approx(tilt, abs=0.003)
    assert estimate.tilt_rate == pytest.approx(0.4)
    assert estimate.way == pytest.approx(0.0, abs=4e-4)
    assert estimate.dt == pytest.approx(dt)


def test_gravity_corrects_a_wrong_gyro_zero() -> None:
    estimator = Estimator(CONFIGURED, Zero(math.radians(0.05)))
    for tick in range(3000):
        estimate = estimator.update(reading(0.1), (0, 0), tick * 0.01)
    assert estimate.tilt == pytest.approx(0.1, abs=math.radians(0.12))


@given(st.lists(st.integers(-60, 60), min_size=1, max_size=80), st.integers(-0x8000, 0x7FFF))
def test_way_adds_up_across_the_wrap(steps: list[int], start: int) -> None:
    estimator = Estimator(CONFIGURED, Zero(0.0))
    count = start
    estimator.update(reading(0.0), (wrapped(count), wrapped(count)), 0.0)
    for tick, step in enumerate(steps, 1):
        count += step
        estimate = estimator.update(reading(0.0), (wrapped(count), wrapped(count)), tick * 0.01)
    # Gravity says "upright" all the time; what its tilt estimate does meanwhile is worth millimetres.
    assert estimate.way == pytest.approx(sum(steps) / PER_METRE, abs=2e-3)


def turning(rate: float, tilt: float = 0.0, zero: float = 0.0) -> imu.ImuReading:
    """Turning left about the vertical while leaning."""
    return reading(tilt)._replace(up_rate=rate * math.cos(tilt) + zero, back_rate=rate * math.sin(tilt) + zero)


@pytest.mark.parametrize("tilt", [0.0, 0.5, -0.5])
def test_heading_by_wheels_and_by_gyro(tilt: float) -> None:
    estimator = Estimator(CONFIGURED, Zero(0.0, 0.03, 0.03))
    estimator.update(turning(1.0, tilt, 0.03), (0, 0), 0.0)
    rate = 1000 / PER_METRE / CONFIGURED.track
    for tick in range(1, 101):
        estimate = estimator.update(turning(rate, tilt, 0.03), (-5 * tick, 5 * tick), tick * 0.01)
    assert estimate.wheel_heading == pytest.approx(rate, abs=1e-3)
    assert estimate.gyro_heading == pytest.approx(rate, rel=5e-3)
    assert estimate.heading == pytest.approx(rate, rel=5e-3)
    assert estimate.turn_rate == pytest.approx(rate)
    assert estimate.way == pytest.approx(0.0, abs=1e-3)


def test_the_wheels_teach_the_gyro_its_zero() -> None:
    estimator = Estimator(CONFIGURED, Zero(0.0))
    for tick in range(18_000):
        estimate = estimator.update(turning(math.radians(0.1)), (0, 0), tick * 0.01)
    assert estimate.gyro_heading == pytest.approx(math.radians(18), rel=0.01)
    assert estimate.heading == pytest.approx(0.0, abs=math.radians(1.2))


def test_a_robot_turned_by_hand_knows_it() -> None:
    """Lifted off the floor: the wheels say nothing, and may not teach the gyro that it does not turn."""
    estimator = Estimator(CONFIGURED, Zero(0.0))
    for tick in range(401):
        estimate = estimator.update(turning(1.0 if 100 <= tick < 300 else 0.0), (0, 0), tick * 0.01)
    assert estimate.heading == pytest.approx(2.0, abs=0.02)


def test_way_in_the_plane_is_an_arc() -> None:
    """A quarter circle to the left, with uneven ticks: what 100 Hz integrates, a difference of sums keeps."""
    estimator = Estimator(CONFIGURED, Zero(0.0))
    radius, now, angle = 0.5, 0.0, 0.0
    estimator.update(turning(0.4), (0, 0), 0.0)
    while angle < math.pi / 2:
        step = (0.01, 0.03)[round(now * 100) % 2]
        now, angle = now + step, angle + 0.4 * step
        counts = [round(angle * (radius + side * CONFIGURED.track / 2) * PER_METRE) for side in (-1, 1)]
        estimate = estimator.update(turning(0.4), (wrapped(counts[0]), wrapped(counts[1])), now)
    assert (estimate.x, estimate.y) == (
        pytest.approx(radius * math.sin(angle), abs=0.01),
        pytest.approx(radius * (1 - math.cos(angle)), abs=0.01),
    )


@given(st.lists(st.floats(-1.0, 0.03).filter(lambda shift: shift == 0 or abs(shift) > 1e-6), min_size=1, max_size=60))
def test_a_clock_that_stands_or_goes_back_changes_nothing(shifts: list[float]) -> None:
    estimator = Estimator(CONFIGURED, Zero(0.0))
    now = 100.0
    estimator.update(reading(0.2, 0.0), (0, 0), now)
    for shift in shifts:
        now += shift
        estimate = estimator.update(reading(0.2, 0.0), (0, 0), now)
        assert estimate.dt >= 0.0
        assert estimate.tilt == pytest.approx(0.2, abs=0.01)
        assert abs(estimate.speed) < 0.2
    assert (estimator.backwards > 0) == any(shift <= 0 for shift in shifts)


def test_a_reset_counter_is_reported_once_and_costs_no_way() -> None:
    estimator = Estimator(CONFIGURED, Zero(0.0))
    estimator.update(reading(0.0), (9000, 9000), 0.0)
    before = estimator.update(reading(0.0), (9010, 9010), 0.01)
    with pytest.raises(RemoteError, match="encoders jumped by -9010"):
        estimator.update(reading(0.0), (0, 0), 0.02)
    after = estimator.update(reading(0.0), (5, 5), 0.03)
    assert after.way - before.way == pytest.approx(5 / PER_METRE, abs=5e-4)


def test_after_a_gap_it_begins_from_gravity_and_keeps_its_way() -> None:
    estimator = Estimator(CONFIGURED, Zero(0.0))
    estimator.update(reading(0.0), (0, 0), 0.0)
    for tick in range(1, 11):
        before = estimator.update(reading(0.0), (20 * tick, 20 * tick), tick * 0.01)
    estimator.lost_track()
    after = estimator.update(reading(1.9), (-7, -7), 30.0)
    assert after.tilt == pytest.approx(1.9)
    assert after.way == pytest.approx(before.way)
    assert after.speed == 0.0


@given(st.lists(st.tuples(*[st.integers(-0x8000, 0x7FFF)] * 4, st.floats(0, 0.3)), max_size=40))
def test_any_samples_give_finite_estimates(samples) -> None:
    estimator, now = Estimator(CONFIGURED, Zero(0.0)), 0.0
    for rate, up, back, count, dt in samples:
        now += dt
        sample = imu.ImuReading(rate * imu.GYRO_SCALE, up * imu.ACCELERATION_SCALE, back * imu.ACCELERATION_SCALE)
        try:
            estimate = estimator.update(sample, (count, -count - 1), now)
        except RemoteError:
            continue
        assert all(map(math.isfinite, estimate))
        assert -math.pi <= estimate.tilt <= math.pi
