"""A robot's body without its physics: a cart that drives as the balancer's set-point does, stands, lies and gets up.

`differential` follows speed and turn rate by the ramps and limits of the balancer's drive core, and its sensors err;
`point` follows them at once and knows its own motion exactly. What the physics would add, a sway of centimetres and the
lag behind the set-point, is left out. Times and ways of getting up are those of the simulated body with physics.

A body moves in whole ticks, and what is done to it acts from its last tick on. So who looks at it, and when, changes
nothing: a run that is recorded is the run that is not.
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
_SECOND = 100
"""Ticks for which the drift of a gyro at rest is drawn in one go."""

STAND_UP, LIE_DOWN = 0.85, 0.41
"""Seconds from the command until it balances or lies; measured with physics (0.84 to 1.06, and 0.41)."""
RISE_WAY = 0.36
"""Distance that the robot rolls while it gets up, m: backward from the front, forward from the back (0.33 to 0.41)."""
FALL_WAY = 0.15
"""Distance by which lying down takes the robot forward, m."""
TOPPLES = 0.45
"""Smallest push that throws a robot over, N s; with physics 0.40 to 0.50 (tests/sim/core/test_body_physics.py)."""
RECOVERS_S = 0.3
"""Seconds in which a robot recovers from a push. Pushes meanwhile add up, with weights that fall as
exp(-t / RECOVERS_S). So two robots that drive into each other fall from 0.15 m/s each on; with physics they bear 0.1
and fall at 0.3."""
TOPPLE_WAY = 0.5
"""Distance from where a robot stood to where it lies after such a push, m; with physics 0.52."""
LYING = math.radians(110)
"""Tilt of a robot that lies."""

GYRO_BIAS = 2e-4
"""Error of the gyro's zero after it was measured at rest, rad/s (standard deviation, with physics)."""
GYRO_WALK = math.radians(7e-3)
"""Drift of the gyro, rad / sqrt(s): the LSM6DS33's noise, 7 mdps / sqrt(Hz)."""
WAY_SCALE = 0.005
"""Share by which the wheels' radius errs (standard deviation) [estimate]."""

BALANCING, IDLE, STANDING, FALLING, FAULT = "balancing", "idle", "standing_up", "lying_down", "fault"

_AT_ONCE = 1e9
"""Acceleration of a body without inertia, m/s^2 and rad/s^2."""


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
        self._tick = 0
        """Ticks that the body has made."""
        self._until = 0
        """The tick at which the manoeuvre under way is over, or the command to drive."""
        self._roll = 0.0
        """Speed during a manoeuvre, m/s."""
        self._gauss = gauss
        errors = model == DIFFERENTIAL
        self._bias = gauss(0.0, GYRO_BIAS) if errors else 0.0
        self._walk = GYRO_WALK if errors else 0.0
        self._scale = 1.0 + (gauss(0.0, WAY_SCALE) if errors else 0.0)
        self._way = self._gyro = self._turned = 0.0
        self._own = (0.0, 0.0)
        self._sequence = 0
        self._borne, self._borne_at = 0.0, 0.0
        """Sum of the last pushes, N s, and the time of the last one, s."""

    @property
    def posture(self) -> str:
        """Return upright, front or back, as the balancer has it by the tilt."""
        return "upright" if abs(self.tilt) < math.radians(20) else "front" if self.tilt > 0.0 else "back"

    @property
    def demand(self) -> tuple[float, float]:
        """Return the speed (m/s) and the turn rate (rad/s) of the motion."""
        return (self._drive.speed, self._drive.turn_rate) if self.mode == BALANCING else (self._roll, 0.0)

    @property
    def next_change(self) -> float:
        """Return when its mode changes by itself, s; infinity where it does not."""
        return self._until * PERIOD if self.mode in (STANDING, FALLING) else math.inf

    @property
    def moves(self) -> bool:
        """Whether it drives, stands up or lies down, or may still do so by its last command."""
        drives = self._drive.speed != 0.0 or self._drive.turn_rate != 0.0 or self._tick < self._until
        return self.mode in (STANDING, FALLING) or (self.mode == BALANCING and drives)

    # -- what is done to it ------------------------------------------------------------------------------------

    def command(self, mode: str, now: float) -> None:
        """Obey `stand`, `rest`, `lie` or `calibrate` as the balancer does. Raises `LocalError` for what is not
        possible."""
        self._settle(now)
        match mode:
            case "stand" if self.mode not in (BALANCING, STANDING):
                self.fault = ""
                side = {"front": -1.0, "back": 1.0, "upright": 0.0}[self.posture]
                self._manoeuvre(STANDING, STAND_UP if side else 5 * PERIOD, side * RISE_WAY)
            case "stand":
                pass
            case "rest":
                self._fall(IDLE)
            case "lie":
                if self.mode != BALANCING:
                    raise LocalError(f"mode lie: only a balancing robot can lie down, this one is {self.mode}")
                self._manoeuvre(FALLING, LIE_DOWN, FALL_WAY)
            case "calibrate":
                if self.mode != IDLE:
                    raise LocalError(f"mode calibrate: the robot must be idle, this one is {self.mode}")
            case _:
                raise LocalError(f"mode {mode!r}: expected one of stand, rest, lie, calibrate")

    def drive(self, speed: float, turn_rate: float, seconds: float, now: float) -> str:
        """Drive for a time. Return what was cut to the limits, or "". Raises `LocalError` where it is not possible."""
        self._settle(now)
        check_command(speed, turn_rate, seconds)
        if self.mode != BALANCING:
            raise LocalError(f"velocity: only a balancing robot drives, this one is {self.mode}")
        self._until = self._tick + max(1, math.ceil(seconds / PERIOD - 1e-6))
        # Half a tick sooner: what ticks add up to is not exact.
        return self._drive.command(speed, turn_rate, (self._until - 0.5) * PERIOD)

    def stop(self, reason: str, now: float) -> None:
        """Switch the motors off: a robot that stood falls on its front."""
        self._settle(now)
        self._fall(FAULT)
        self.fault = reason

    def lay(self, side: str, now: float) -> None:
        """Be laid down, on the back or the front."""
        self._settle(now)
        self._fall(IDLE if self.mode != FAULT else FAULT)
        self.tilt = -LYING if side == "back" else LYING

    def push(self, impulse: float, now: float) -> None:
        """Be pushed forward, N s. From a small push the robot has rolled back a few seconds later; a larger one throws
        it over, and it slides on as it falls."""
        self._settle(now)
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
        """Be hit by another robot: slide aside (m, the wheels do not turn), and be pushed forward, N s."""
        self._settle(now)
        self.x += dx
        self.y += dy
        self.push(impulse, now)

    # -- motion ------------------------------------------------------------------------------------------------

    def advance(self, now: float) -> None:
        """Advance the body to its last tick, at rest to its last whole second, up to the time `now`."""
        tick = _tick_at(now)
        while self._tick < tick:
            if self.moves:
                self._step()
                if self.mode in (STANDING, FALLING) and self._tick >= self._until:
                    self._arrive()
            else:
                second = self._tick - self._tick % _SECOND + _SECOND
                if second > tick:
                    return
                self._rest(second - self._tick)

    def _settle(self, now: float) -> None:
        """Advance the body to its last tick up to the time `now`, before something is done to it."""
        self.advance(now)
        if (ticks := _tick_at(now) - self._tick) > 0:
            self._rest(ticks)

    def odometry(self, now: float) -> Odometry:
        """Return the sums of the body's sensors."""
        self.advance(now)
        self._sequence += 1
        half = 0.5 * self._track * self._turned
        gyro = self._gyro + self._bias * (now - self._tick * PERIOD)
        return Odometry(
            t=now,
            sequence=self._sequence,
            left=self._way - half,
            right=self._way + half,
            x=self._own[0],
            y=self._own[1],
            heading=gyro,
            gyro_heading=gyro,
            wheel_heading=self._turned,
            tilt=self.tilt,
        )

    def _step(self) -> None:
        drive, dt = self._drive, PERIOD
        if self.mode == BALANCING:
            drive.step(drive.way, drive.heading, self._tick * PERIOD, dt)
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
        self._rest(1)

    def _rest(self, ticks: int) -> None:
        """Let ticks pass, and add the gyro's own drift."""
        self._tick += ticks
        if self._walk:
            seconds = ticks * PERIOD
            self._gyro += self._bias * seconds + self._gauss(0.0, self._walk * math.sqrt(seconds))

    def _manoeuvre(self, mode: str, seconds: float, way: float) -> None:
        self.mode, self._until, self._roll = mode, self._tick + round(seconds / PERIOD), way / seconds

    def _arrive(self) -> None:
        """End a manoeuvre."""
        self._roll = 0.0
        if self.mode == STANDING:
            self.mode, self.tilt = BALANCING, 0.0
            self._drive.begin(0.0, 0.0)
        else:
            self.mode, self.tilt = IDLE, LYING

    def _fall(self, mode: str) -> None:
        if self.mode in (BALANCING, STANDING, FALLING) and self.posture == "upright":
            self.tilt = LYING
        self.mode, self.fault, self._roll = mode, "", 0.0
        self._drive.begin(0.0, 0.0)


def _tick_at(now: float) -> int:
    """Return the number of the last tick up to a time."""
    return int(now / PERIOD + 1e-6)
