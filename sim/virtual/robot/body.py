"""A robot's body without its physics: a cart that drives as the balancer's set-point does, stands, lies and gets up.

`differential` follows speed and turn rate by the ramps and limits of the balancer's drive core, and its sensors err;
`point` follows them at once and knows its own motion exactly. What the physics would add, a sway of centimetres and the
lag behind the set-point, is left out. Times and ways of getting up are those of the simulated body with physics.
"""

import math
from collections.abc import Callable

from services.balancer.core.control.body import body_model
from services.balancer.core.control.drive import Drive, DriveLimits, check_command
from services.balancer.core.faults import FELL
from swarm.config.types import Balancing, Body
from swarm.errors import LocalError
from swarm.messages import Odometry

POINT, DIFFERENTIAL = "point", "differential"
MODELS = (DIFFERENTIAL, POINT)

PERIOD = 0.01
"""Seconds between two steps of a motion, the balancer's tick."""

STAND_UP, LIE_DOWN = 0.85, 0.41
"""Seconds from the command until it balances or lies; measured with physics (0.84 to 1.06, and 0.41)."""
RISE_WAY = 0.36
"""Distance that the robot rolls while it gets up, m: backward from the front, forward from the back (0.33 to 0.41)."""
FALL_WAY = 0.15
"""m forward that lying down takes."""
TOPPLES = 0.45
"""N s of a push that it bears no more, with physics 0.40 to 0.50 (tests/sim/core/test_body_physics.py)."""
RECOVERS_S = 0.3
"""Seconds in which a robot rolls back what it bore: what pushes it meanwhile adds up, with weights that fall as
exp(-t / RECOVERS_S). So two that drive into each other fall from 0.15 m/s each on; with physics they bear 0.1 and
fall at 0.3."""
TOPPLE_WAY = 0.5
"""m from where it stood to where it lies then, with physics 0.52."""
LYING = math.radians(110)
"""Tilt of a robot that lies."""

GYRO_BIAS = 2e-4
"""rad/s: what is left of the gyro's zero after it was measured at rest (standard deviation, with physics)."""
GYRO_WALK = math.radians(7e-3)
"""rad / sqrt(s): the LSM6DS33's noise, 7 mdps / sqrt(Hz)."""
WAY_SCALE = 0.005
"""Of the wheels' radius (standard deviation) [estimate]."""

BALANCING, IDLE, STANDING, FALLING, FAULT = "balancing", "idle", "standing_up", "lying_down", "fault"

_AT_ONCE = 1e9
"""m/s^2 and rad/s^2 of a body without inertia."""


class VirtualBody:
    """One robot's motion. Calls with `now` must not go back in time."""

    def __init__(
        self,
        model: str,
        shape: Body,
        settings: Balancing,
        place: tuple[float, float, float],
        gauss: Callable[[float, float], float],
    ) -> None:
        """`place`: x, y (m) and heading (rad), where it stands and balances at the time 0."""
        self.x, self.y, self.heading = place
        self.tilt = 0.0
        """rad, forward positive."""
        self.mode = BALANCING
        self.fault = ""
        limits = DriveLimits(
            settings.max_speed, settings.max_turn_rate, settings.acceleration, settings.turn_acceleration
        )
        if model == POINT:
            limits = limits._replace(acceleration=_AT_ONCE, turn_acceleration=_AT_ONCE)
        body = body_model("zero2w", shape)
        self._track = body.track
        self._drive = Drive(body, limits)
        self._now = 0.0
        self._until = 0.0
        """The time at which the manoeuvre under way is over, or the command to drive."""
        self._roll = 0.0
        """m/s, during a manoeuvre."""
        self._gauss = gauss
        errors = model == DIFFERENTIAL
        self._bias = gauss(0.0, GYRO_BIAS) if errors else 0.0
        self._walk = GYRO_WALK if errors else 0.0
        self._scale = 1.0 + (gauss(0.0, WAY_SCALE) if errors else 0.0)
        self._way = self._gyro = self._turned = 0.0
        self._own = (0.0, 0.0)
        self._sequence = 0
        self._borne, self._borne_at = 0.0, 0.0
        """Of the last pushes, N s, and when that was."""

    @property
    def posture(self) -> str:
        """upright, front or back, as the balancer has it by the tilt."""
        return "upright" if abs(self.tilt) < math.radians(20) else "front" if self.tilt > 0.0 else "back"

    @property
    def demand(self) -> tuple[float, float]:
        """Speed (m/s) and turn rate (rad/s) it moves with."""
        return (self._drive.speed, self._drive.turn_rate) if self.mode == BALANCING else (self._roll, 0.0)

    @property
    def next_change(self) -> float:
        """Return when its mode changes by itself, s; infinity where it does not."""
        return self._until if self.mode in (STANDING, FALLING) else math.inf

    @property
    def moves(self) -> bool:
        """Whether it drives, stands up or lies down, or may still do so by its last command."""
        drives = self._drive.speed != 0.0 or self._drive.turn_rate != 0.0 or self._now < self._until
        return self.mode in (STANDING, FALLING) or (self.mode == BALANCING and drives)

    # -- what is done to it ------------------------------------------------------------------------------------

    def command(self, mode: str, now: float) -> None:
        """`stand`, `rest`, `lie` or `calibrate`, as the balancer obeys them; `LocalError` for what cannot be now."""
        self.advance(now)
        match mode:
            case "stand" if self.mode not in (BALANCING, STANDING):
                self.fault = ""
                side = {"front": -1.0, "back": 1.0, "upright": 0.0}[self.posture]
                self._manoeuvre(STANDING, now, STAND_UP if side else 5 * PERIOD, side * RISE_WAY)
            case "stand":
                pass
            case "rest":
                self._fall(IDLE)
            case "lie":
                if self.mode != BALANCING:
                    raise LocalError(f"mode lie: only a balancing robot can lie down, this one is {self.mode}")
                self._manoeuvre(FALLING, now, LIE_DOWN, FALL_WAY)
            case "calibrate":
                if self.mode != IDLE:
                    raise LocalError(f"mode calibrate: the robot must be idle, this one is {self.mode}")
            case _:
                raise LocalError(f"mode {mode!r}: expected one of stand, rest, lie, calibrate")

    def drive(self, speed: float, turn_rate: float, seconds: float, now: float) -> str:
        """Drive for a time. Returns what was cut to the limits, or ""; `LocalError` where it cannot be done."""
        self.advance(now)
        check_command(speed, turn_rate, seconds)
        if self.mode != BALANCING:
            raise LocalError(f"velocity: only a balancing robot drives, this one is {self.mode}")
        self._until = now + seconds
        return self._drive.command(speed, turn_rate, self._until)

    def stop(self, reason: str, now: float) -> None:
        """Motors off: a robot that stood falls on its front."""
        self.advance(now)
        self._fall(FAULT)
        self.fault = reason

    def lay(self, side: str, now: float) -> None:
        """Somebody lays it down, on its back or front."""
        self.advance(now)
        self._fall(IDLE if self.mode != FAULT else FAULT)
        self.tilt = -LYING if side == "back" else LYING

    def push(self, impulse: float, now: float) -> None:
        """Somebody pushes it, N s forward. What it bears it has rolled back from a few seconds later; more than that
        throws it over, and it slides on as it falls."""
        self.advance(now)
        if self.mode not in (BALANCING, STANDING):
            return
        impulse += self._borne * math.exp((self._borne_at - now) / RECOVERS_S)
        self._borne, self._borne_at = impulse, now
        if abs(impulse) < TOPPLES:
            return
        self._borne = 0.0
        way = math.copysign(TOPPLE_WAY, impulse)
        self.x += way * math.cos(self.heading)
        self.y += way * math.sin(self.heading)
        self._fall(FAULT)
        self.tilt = math.copysign(LYING, impulse)
        self.fault = FELL

    def knock(self, impulse: float, dx: float, dy: float, now: float) -> None:
        """Another robot hits it: it slides aside (m, the wheels do not turn), and is pushed forward, N s."""
        self.advance(now)
        self.x += dx
        self.y += dy
        self.push(impulse, now)

    # -- motion ------------------------------------------------------------------------------------------------

    def advance(self, now: float) -> None:
        """Advance the body to the time `now`."""
        while self._now < now:
            if self.mode == BALANCING:
                if self._drive.speed == 0.0 == self._drive.turn_rate and self._now >= self._until:
                    self._rest(now - self._now)
                    self._now = now
                    return
                # A command ends when it ends, wherever in a period that is.
                left = self._until - self._now
                self._step(min(PERIOD, now - self._now, max(left, 1e-9) if left > 0.0 else PERIOD))
            elif self.mode in (STANDING, FALLING):
                self._step(min(PERIOD, now - self._now, max(self._until - self._now, 1e-9)))
                if self._now >= self._until:
                    self._arrive()
            else:
                self._rest(now - self._now)
                self._now = now

    def odometry(self, now: float) -> Odometry:
        """Return the sums of its sensors."""
        self.advance(now)
        self._sequence += 1
        half = 0.5 * self._track * self._turned
        return Odometry(
            t=now,
            sequence=self._sequence,
            left=self._way - half,
            right=self._way + half,
            x=self._own[0],
            y=self._own[1],
            heading=self._gyro,
            gyro_heading=self._gyro,
            wheel_heading=self._turned,
            tilt=self.tilt,
        )

    def _step(self, dt: float) -> None:
        drive = self._drive
        if self.mode == BALANCING:
            drive.step(drive.way, drive.heading, self._now, dt)
            speed, turn_rate = drive.speed, drive.turn_rate
        else:
            speed, turn_rate = self._roll, 0.0
        middle = self.heading + 0.5 * turn_rate * dt
        self.x += speed * dt * math.cos(middle)
        self.y += speed * dt * math.sin(middle)
        self.heading += turn_rate * dt
        way = self._scale * speed * dt
        own = self._gyro + 0.5 * turn_rate * dt
        self._own = (self._own[0] + way * math.cos(own), self._own[1] + way * math.sin(own))
        self._way += way
        self._turned += self._scale * turn_rate * dt
        self._gyro += turn_rate * dt
        self._rest(dt)
        self._now += dt

    def _rest(self, dt: float) -> None:
        """Add the gyro's own drift."""
        if self._walk:
            self._gyro += self._bias * dt + self._gauss(0.0, self._walk * math.sqrt(dt))

    def _manoeuvre(self, mode: str, now: float, seconds: float, way: float) -> None:
        self.mode, self._until, self._roll = mode, now + seconds, way / seconds

    def _arrive(self) -> None:
        """The end of a manoeuvre."""
        self._roll = 0.0
        if self.mode == STANDING:
            self.mode, self.tilt, self._until = BALANCING, 0.0, self._now
            self._drive.begin(0.0, 0.0)
        else:
            self.mode, self.tilt = IDLE, LYING

    def _fall(self, mode: str) -> None:
        if self.mode in (BALANCING, STANDING, FALLING) and self.posture == "upright":
            self.tilt = LYING
        self.mode, self.fault, self._roll = mode, "", 0.0
        self._drive.begin(0.0, 0.0)
