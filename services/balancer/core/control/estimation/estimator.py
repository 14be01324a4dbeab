"""The estimator of the body: tilt from gyro and gravity, way and speed from the wheels, with the real duration of
each tick."""

import math
from typing import NamedTuple

from services.balancer.core.control.body import BodyModel
from services.balancer.core.control.estimation.gyro import Zero
from services.balancer.core.control.estimation.heading import Heading
from services.balancer.core.devices import balboa, imu
from swarm.errors import RemoteError

GRAVITY_TIME_S = 2.0
"""Time constant with which gravity corrects the integrated gyro while the robot moves: short enough against the
gyro's residual zero (0.05 deg/s x 2 s = 0.1 deg), long against the accelerations of balancing."""
REST_TIME_S = 0.1
"""The time constant of that correction while the robot rests."""
REST_RATE = math.radians(2.0)
GRAVITY_TOLERANCE = 1.5
"""m/s^2: a specific force further from 1 g says more of acceleration than of gravity and is not used."""

SPEED_TIME_S = 0.01
"""Time constant of the speed's filter: a tick of 10 ms counts half. One count in a tick is 0.019 m/s."""
LOST_TRACK_S = balboa.MOTOR_TIMEOUT_S
"""After a gap this long the integral is worthless, and the motors have stopped: tilt is taken from gravity anew. A
robot that fell in the gap would otherwise drive on for a second as if it stood."""


class BodyEstimate(NamedTuple):
    """The state of the body at one tick."""

    t: float
    dt: float
    """Seconds since the last tick, 0 where the clock did not advance."""
    tilt: float
    """rad from upright, -pi..pi, positive = forward."""
    tilt_rate: float
    """rad/s."""
    left: float
    """Way of the left wheel since the start, m."""
    right: float
    speed: float
    """Speed of the axle, forward, m/s."""
    heading: float
    """Heading by gyro and wheels, rad since the start, counter-clockwise positive, not wrapped."""
    turn_rate: float
    """Turn rate by the gyro, rad/s."""
    gyro_heading: float
    """Heading by the gyro alone, rad."""
    wheel_heading: float
    """Heading by the wheels alone, rad."""
    x: float
    """Way ahead in the plane of the start, m."""
    y: float
    """Way to the left in the plane of the start, m."""

    @property
    def way(self) -> float:
        """Return the distance of the axle since the start, m."""
        return (self.left + self.right) / 2


class Estimator:
    """Fuses IMU and encoders."""

    def __init__(self, body: BodyModel, gyro_zero: Zero) -> None:
        self._radius = body.wheel_radius
        self._track = body.track
        self._radians_per_count = math.tau / body.counts_per_turn
        # A wheel cannot turn faster than a pulled motor; a bit for a stale count. More means a counter that was reset.
        self._fastest = 2 * body.free_speed / self._radians_per_count
        self.gyro_zero = gyro_zero
        """May be replaced by a newer one at any time."""
        self._heading = Heading()
        self._last: float | None = None
        self._rate = 0.0
        self._tilt = 0.0
        self._tilt_origin = 0.0
        self._counters = (0, 0)
        self._turned = [0, 0]
        self._way = 0.0
        self._speed = self._last_speed = 0.0
        self._turn_rate = 0.0
        self.backwards = 0
        """Ticks at which the clock had not advanced."""

    def lost_track(self) -> None:
        """Samples were missed (a bus failure): begin anew from gravity and the next counters; keep the way."""
        self._last = None

    def update(self, reading: imu.ImuReading, counters: tuple[int, int], now: float) -> BodyEstimate:
        """Take one sample. Raises `RemoteError` when the counters jumped (the ATmega was reset); the next is good."""
        rate = reading.pitch_rate - self.gyro_zero.pitch
        if self._last is None or now - self._last > LOST_TRACK_S:
            return self._begin(reading, rate, counters, now)
        before = self._left_and_right()
        dt = max(0.0, now - self._last)
        if dt == 0.0:
            self.backwards += 1
        steps = [balboa.encoder_step(old, new) for old, new in zip(self._counters, counters, strict=True)]
        self._counters = counters
        self._last = now
        self._integrate(reading, rate, dt)
        if max(map(abs, steps)) > self._fastest * max(dt, 0.01) + 50:
            raise RemoteError(f"ATmega: encoders jumped by {steps[0]} and {steps[1]} counts")
        self._turned[0] += steps[0]
        self._turned[1] += steps[1]
        zero = self.gyro_zero
        self._turn_rate = imu.turn_rate(reading.up_rate - zero.up, reading.back_rate - zero.back, self._tilt)
        after = self._left_and_right()
        steps_m = after[0] - before[0], after[1] - before[1]
        self._heading.update(self._turn_rate, (steps_m[1] - steps_m[0]) / self._track, sum(steps_m) / 2, dt)
        return self._estimate(now, dt)

    def _begin(self, reading: imu.ImuReading, rate: float, counters: tuple[int, int], now: float) -> BodyEstimate:
        tilt = imu.gravity_tilt(reading)
        self._tilt_origin += tilt - self._tilt
        self._tilt, self._rate, self._counters, self._last = tilt, rate, counters, now
        estimate = self._estimate(now, 0.0)
        self._way, self._speed, self._last_speed = estimate.way, 0.0, 0.0
        return estimate._replace(speed=0.0)

    def _integrate(self, reading: imu.ImuReading, rate: float, dt: float) -> None:
        tilt = self._tilt + dt * (rate + self._rate) / 2
        self._rate = rate
        force = math.hypot(reading.up, reading.back)
        if dt > 0.0 and abs(force - imu.STANDARD_GRAVITY) < GRAVITY_TOLERANCE:
            time_constant = REST_TIME_S if self._resting(rate) else GRAVITY_TIME_S
            # Without the wheels' acceleration a slow swing to and fro looks like tilt and feeds itself. A difference of
            # speeds is noisy, but its errors cancel from tick to tick within the time constant.
            by_gravity = imu.gravity_tilt(reading, tilt, (self._speed - self._last_speed) / dt)
            tilt += _wrapped(by_gravity - tilt) * dt / (time_constant + dt)
        self._last_speed = self._speed
        # A turn over the head changes the number, not the way that the wheels went.
        wrapped = _wrapped(tilt)
        self._tilt_origin += wrapped - tilt
        self._tilt = wrapped

    def _resting(self, rate: float) -> bool:
        return abs(rate) < REST_RATE and abs(self._speed) < 0.01 and abs(self._tilt) > 1.0

    def _left_and_right(self) -> tuple[float, float]:
        # Encoders count wheel against body: the body's own turn belongs to the wheel's way over the floor.
        body_turn = self._tilt - self._tilt_origin
        left, right = self._turned
        per_count = self._radians_per_count
        return self._radius * (left * per_count + body_turn), self._radius * (right * per_count + body_turn)

    def _estimate(self, now: float, dt: float) -> BodyEstimate:
        left, right = self._left_and_right()
        way = (left + right) / 2
        if dt > 0.0:
            self._speed += ((way - self._way) / dt - self._speed) * dt / (SPEED_TIME_S + dt)
        self._way = way
        heading = self._heading
        return BodyEstimate(
            now,
            dt,
            self._tilt,
            self._rate,
            left,
            right,
            self._speed,
            heading.value,
            self._turn_rate,
            heading.gyro,
            (right - left) / self._track,
            heading.x,
            heading.y,
        )


def _wrapped(angle: float) -> float:
    """Return the angle, rad, as a value from -pi to pi."""
    return math.remainder(angle, math.tau)
