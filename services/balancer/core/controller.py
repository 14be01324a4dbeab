"""What the motors shall do: the modes of the balancer, the way to stand up, and what ends it.

    idle --stand--> standing_up --upright--> balancing        rest: to idle from anywhere
                        |  gave up               |  fell, full power too long
                        +-------> fault <--------+            stop and failures: to fault from anywhere

A fault keeps the motors off until the next command. Balancing needs no commands to go on.
"""

import math
from collections.abc import Sequence

from services.balancer.core.estimator import Estimate
from swarm.errors import LocalError

STARTING = "starting"
"""Before the controller has an estimate to work on; it is never in this mode itself."""
IDLE = "idle"
STANDING_UP = "standing_up"
BALANCING = "balancing"
FAULT = "fault"

COMMANDS = ("stand", "rest")

DUTY_LIMIT = 0.75
"""300 of 400, Pololu's limit for the sake of the motors."""

UPRIGHT = math.radians(20)
"""Held within this angle it starts to balance."""
UPRIGHT_TICKS = 5
FALLEN = math.radians(70)
FALLEN_TICKS = 5
FULL_POWER_S = 1.0
"""Full power for longer than a push ever takes means wheels in the air."""

LYING = (math.radians(85), math.radians(135))
"""Tilt of a robot that lies on its front or back, both near 110 degrees."""
LYING_S = 0.3
LYING_RATE = math.radians(10)
RUN_UP_S = 0.4
"""Full power towards the side it lies on, so that turning round swings it up."""
SWING_S = 0.6
"""Longest swing; then the try has failed."""
CATCH = math.radians(30)
SWING_DUTIES = (DUTY_LIMIT, 0.9, 1.0)
"""Power of the first try and of the next ones: spares the motors where little is enough."""
PATIENCE_S = 10.0
"""How long it looks for a position it can stand up from."""
PROVEN_S = 1.5
"""A fall within this time after the swing is a failed try, not a fall."""

WAY_LIMIT = 0.5
"""m: a robot carried further off is drawn back no harder than this, at some 0.13 m/s."""
TRIM_TIME_S = 8.0
TRIM_RANGE = math.radians(6)
"""The tilt at which it balances is learned from the way (the accelerometer's zero is uncertain by a degree or two):
without it the robot would settle beside its place, where the pull of the way makes up for the wrong upright."""

HEADING_GAIN = 0.15
"""Duty a radian, added right and taken left."""
HEADING_LIMIT = 0.1


class Regulator:
    """State feedback u = k . (x, x', th, th', previous u) with its limit; gains from `lqr.gains`."""

    def __init__(self, gains: Sequence[float]) -> None:
        self._gains = tuple(gains)
        self.tilt_per_way = self._gains[0] / self._gains[2]
        """rad a metre: this error of upright is made up for by standing a metre off."""
        self._last = 0.0

    def reset(self, duty: float) -> None:
        """Begin after `duty` was commanded."""
        self._last = duty

    def duty(self, way: float, speed: float, tilt: float, tilt_rate: float) -> float:
        """The next command of both motors, -DUTY_LIMIT..DUTY_LIMIT."""
        k_x, k_v, k_th, k_rate, k_u = self._gains
        duty = k_x * way + k_v * speed + k_th * tilt + k_rate * tilt_rate + k_u * self._last
        self._last = min(DUTY_LIMIT, max(-DUTY_LIMIT, duty))
        return self._last


class Controller:
    """Modes and motor commands; one `step` a tick."""

    def __init__(self, regulator: Regulator, trim: float) -> None:
        """`trim` as in the config's [body], rad."""
        self._regulator = regulator
        self._configured_trim = trim
        self.mode = IDLE
        self.fault = ""
        self._phase = ""
        self._since = 0.0
        self._phase_since = 0.0
        self._tries = 0
        self._power = 0.0
        self._swung = False
        self._count = 0
        self._full_power_s = 0.0
        self._trim = trim
        self._place = 0.0
        self._heading = 0.0

    @staticmethod
    def check(mode: str) -> None:
        """Raises `LocalError` where `mode` is none."""
        if mode not in COMMANDS:
            raise LocalError(f"mode {mode!r}: expected one of {', '.join(COMMANDS)}")

    def command(self, mode: str, now: float) -> None:
        """`stand` or `rest`; a new command also leaves a fault. Raises `LocalError` for another one."""
        self.check(mode)
        self.fault = ""
        if mode == "rest":
            self.mode = IDLE
        elif self.mode not in (STANDING_UP, BALANCING):
            self._tries = 0
            self._look(now)

    def fail(self, reason: str) -> None:
        """Motors off until the next command. The first reason stays: what follows it is mostly its consequence."""
        if self.mode != FAULT:
            self.mode, self.fault = FAULT, reason

    def step(self, estimate: Estimate) -> tuple[float, float]:
        """Duties of the left and right motor for this tick."""
        if not math.isfinite(sum(estimate)):  # one that is not spoils the sum
            self.fail("the estimate is not a number")
        if self.mode == STANDING_UP:
            duty = self._stand_up(estimate)
        elif self.mode == BALANCING:
            duty = self._balance(estimate)
        else:
            return 0.0, 0.0
        if self.mode not in (STANDING_UP, BALANCING):
            return 0.0, 0.0
        turn = 0.0
        if self.mode == BALANCING:
            error = math.remainder(self._heading - estimate.heading, math.tau)
            turn = min(HEADING_LIMIT, max(-HEADING_LIMIT, HEADING_GAIN * error))
        return duty - turn, duty + turn

    # Standing up: look -> (run_up -> swing ->) balancing

    def _look(self, now: float) -> None:
        self.mode, self._phase = STANDING_UP, "look"
        self._since = self._phase_since = now
        self._count = 0

    def _stand_up(self, estimate: Estimate) -> float:
        now, tilt = estimate.t, estimate.tilt - self._configured_trim
        if self._phase == "look":
            return self._looking(estimate, tilt)
        if self._phase == "run_up":
            if now - self._phase_since < RUN_UP_S:
                return -self._power
            self._phase, self._phase_since = "swing", now
        if abs(tilt) < CATCH:
            self._catch(estimate, math.copysign(DUTY_LIMIT, self._power), swung=True)
            return self._balance(estimate)
        if now - self._phase_since > SWING_S:
            self._try_again(now)
            return 0.0
        return self._power

    def _looking(self, estimate: Estimate, tilt: float) -> float:
        now = estimate.t
        self._count = self._count + 1 if abs(tilt) < UPRIGHT else 0
        if self._count >= UPRIGHT_TICKS:
            self._catch(estimate, 0.0, swung=False)
            return self._balance(estimate)
        lying = LYING[0] < abs(estimate.tilt) < LYING[1] and abs(estimate.tilt_rate) < LYING_RATE
        if not lying:
            self._phase_since = now
        elif now - self._phase_since > LYING_S:
            self._power = math.copysign(SWING_DUTIES[self._tries], estimate.tilt)
            self._tries += 1
            self._phase, self._phase_since = "run_up", now
            return -self._power
        if now - self._since > PATIENCE_S:
            self.fail("cannot stand up: it neither lies still nor is held upright")
        return 0.0

    def _try_again(self, now: float) -> None:
        if self._tries >= len(SWING_DUTIES):
            self.fail(f"cannot stand up: {self._tries} tries failed")
        else:
            self._look(now)

    # Balancing

    def _catch(self, estimate: Estimate, duty: float, *, swung: bool) -> None:
        self.mode = BALANCING
        self._since, self._swung = estimate.t, swung
        self._count, self._full_power_s = 0, 0.0
        self._trim = self._configured_trim
        self._place, self._heading = estimate.way, estimate.heading
        self._regulator.reset(duty)

    def _balance(self, estimate: Estimate) -> float:
        tilt = estimate.tilt - self._trim
        self._count = self._count + 1 if abs(tilt) > FALLEN else 0
        if self._count >= FALLEN_TICKS:
            if self._swung and estimate.t - self._since < PROVEN_S:
                self._try_again(estimate.t)
            else:
                self.fail("fell")
            return 0.0
        way = min(WAY_LIMIT, max(-WAY_LIMIT, estimate.way - self._place))
        duty = self._regulator.duty(way, estimate.speed, tilt, estimate.tilt_rate)
        if abs(duty) < DUTY_LIMIT:
            self._full_power_s = 0.0
            self._learn_trim(way, estimate.dt)
        else:
            self._full_power_s += estimate.dt
            if self._full_power_s > FULL_POWER_S:
                self.fail("full power for too long: are the wheels in the air?")
        return duty

    def _learn_trim(self, way: float, dt: float) -> None:
        trim = self._trim - self._regulator.tilt_per_way * way * dt / TRIM_TIME_S
        self._trim = min(self._configured_trim + TRIM_RANGE, max(self._configured_trim - TRIM_RANGE, trim))
