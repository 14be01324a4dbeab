"""The controller of the motors: the modes of the balancer, and what ends them.

    idle --stand--> standing_up --upright--> balancing --lie--> lying_down --down--> idle
                        |  gave up               |  fell, full power too long         (or fault: battery)
                        +-------> fault <--------+
    idle --test of motors--> testing --its time is over--> idle
    rest: to idle from anywhere          stop and failures: to fault from anywhere

A fault keeps the motors off until the next command. Balancing needs no commands to go on. `starting` and `calibrating`
are the balancer's (services/balancer/balancer.py): the controller idles meanwhile.
"""

import math
from collections.abc import Mapping

from services.balancer.core import faults
from services.balancer.core.control.drive import Drive, check_command
from services.balancer.core.control.estimation.estimator import BodyEstimate
from services.balancer.core.control.manoeuvres.lie_down import LieDown
from services.balancer.core.control.manoeuvres.motor_trial import MotorTest, check_test
from services.balancer.core.control.manoeuvres.stand_up import StandUpAttempt
from services.balancer.core.control.regulator import Deviation, Regulator, limited
from services.balancer.core.faults import MotorFault
from services.balancer.core.parameters import BalancerParameter, BalancerParameters
from swarm.errors import LocalError
from swarm.messages import TryMotors

STARTING = "starting"
CALIBRATING = "calibrating"
IDLE = "idle"
STANDING_UP = "standing_up"
BALANCING = "balancing"
LYING_DOWN = "lying_down"
TESTING = "testing"
FAULT = "fault"
ON_ITS_FEET = (STANDING_UP, BALANCING, LYING_DOWN)
"""Modes in which the robot falls where the balancer ends."""

COMMANDS = ("stand", "rest", "lie", "calibrate")

FALLEN = math.radians(70)
FALLEN_TICKS = 5
_ROUNDING = 1e-9
"""A duty that is less than this below the regulator's limit is at it."""
FULL_POWER_S = 1.0
"""Full power for longer than a push ever takes means wheels in the air."""
STUCK_TICKS = 20
"""A clock that does not advance for so many ticks is a fault: without time there is no speed and no rate."""
PROVEN_S = 1.5
"""A fall within this time after the swing is a failed try, not a fall."""

WAY_LIMIT = 0.5
"""m: a robot carried further off is drawn back no harder than this, at some 0.13 m/s."""
TRIM_TIME_S = 8.0
TRIM_RANGE = math.radians(6)
"""The tilt at which it balances is learned from the way (the accelerometer's zero is uncertain by a degree or two):
without it the robot would settle beside its place, where the pull of the way makes up for the wrong upright."""


class Controller:
    """Modes and motor commands; one `step` a tick."""

    def __init__(self, regulator: Regulator, drive: Drive, trim: float) -> None:
        """`trim` as in the config's [body], rad."""
        self._regulator = regulator
        self._drive = drive
        limits = drive.limits
        self._parameters = BalancerParameters(
            {
                "trim": BalancerParameter(trim, -0.5, 0.5),
                "heading_gain": BalancerParameter(drive.heading_gain, 0.0, 1.0),
                "max_speed": BalancerParameter(limits.speed, 0.0, limits.speed),
                "max_turn_rate": BalancerParameter(limits.turn_rate, 0.0, limits.turn_rate),
                "acceleration": BalancerParameter(limits.acceleration, 0.05, limits.acceleration),
                "turn_acceleration": BalancerParameter(limits.turn_acceleration, 0.5, limits.turn_acceleration),
                **regulator.parameters,
            }
        )
        self.mode = IDLE
        self.fault: MotorFault | None = None
        self._stand_up: StandUpAttempt | None = None
        self._lie_down: LieDown | None = None
        self._test: MotorTest | None = None
        self._then: MotorFault | None = None
        self._since = 0.0
        self._count = 0
        self._full_power_s = 0.0
        self._stuck = 0
        self._last = -math.inf
        self._trim = trim

    @property
    def configured_trim(self) -> float:
        """Balance point from the IMU's upright, rad, as configured or changed by parameter."""
        return self._parameters.values["trim"]

    @property
    def parameters(self) -> Mapping[str, float]:
        """Return the parameters in force."""
        return self._parameters.values

    @property
    def demand(self) -> tuple[float, float]:
        """Speed and turn rate it drives with, m/s and rad/s."""
        return (self._drive.speed, self._drive.turn_rate) if self.mode == BALANCING else (0.0, 0.0)

    @staticmethod
    def check(mode: str) -> None:
        """Raises `LocalError` where `mode` is none."""
        if mode not in COMMANDS:
            raise LocalError(f"mode {mode!r}: expected one of {', '.join(COMMANDS)}")

    def command(self, mode: str, now: float) -> None:
        """`stand`, `rest` or `lie`; the first two also leave a fault. Raises `LocalError` for what cannot be now."""
        if mode == "rest":
            self.mode, self.fault = IDLE, None
        elif mode == "stand":
            self.fault = None
            if self.mode not in (STANDING_UP, BALANCING):
                self.mode, self._stand_up = STANDING_UP, StandUpAttempt(self.configured_trim, now)
        elif mode == "lie":
            if self.mode not in (BALANCING, LYING_DOWN):
                raise LocalError(f"mode lie: only a balancing robot can lie down, this one is {self.mode}")
            self._lie(now, None)
        else:
            self.check(mode)

    def lie_down(self, now: float, fault: MotorFault) -> None:
        """Lie down if it stands, and be in fault at the end."""
        if self.mode == BALANCING:
            self._lie(now, fault)
        elif self.mode == LYING_DOWN:
            self._then = fault
        else:
            self.fail(fault)

    def fail(self, fault: MotorFault) -> bool:
        """Motors off until the next command. The first reason stays: what follows it is mostly its consequence.

        True where this is the first.
        """
        if self.mode == FAULT:
            return False
        self.mode, self.fault = FAULT, fault
        return True

    def drive(self, speed: float, turn_rate: float, seconds: float, now: float) -> str:
        """Drive for a time. Returns what was cut to the limits, or ""; `LocalError` where it cannot be done."""
        check_command(speed, turn_rate, seconds)
        if self.mode != BALANCING:
            raise LocalError(f"velocity: only a balancing robot drives, this one is {self.mode}")
        return self._drive.command(speed, turn_rate, now + seconds)

    def test_motors(self, request: TryMotors, now: float) -> None:
        """Turn the wheels at low power for a time; raises `LocalError` where it is not idle, or the test is none."""
        check_test(request)
        if self.mode not in (IDLE, TESTING):
            way_out = "swarm balance lie" if self.mode == BALANCING else "swarm balance rest"  # by rest it would fall
            raise LocalError(f"motors: only an idle robot tests them, this one is {self.mode}: {way_out}")
        self.mode, self._test = TESTING, MotorTest(request, now)

    @property
    def silent(self) -> bool:
        """Whether the motors get no command in this tick, by the test of their watchdog."""
        return self.mode == TESTING and self._test is not None and self._test.silent

    def change(self, values: Mapping[str, float]) -> None:
        """Change parameters; raises `LocalError` and changes none where one is unknown or out of range."""
        self._parameters.change(values)
        now = self._parameters.values
        self._regulator.tune(now)
        self._drive.heading_gain = now["heading_gain"]
        self._drive.limits = self._drive.limits._replace(
            speed=now["max_speed"],
            turn_rate=now["max_turn_rate"],
            acceleration=now["acceleration"],
            turn_acceleration=now["turn_acceleration"],
        )
        if "trim" in values:
            self._trim = values["trim"]

    def step(self, estimate: BodyEstimate) -> tuple[float, float]:
        """Duties of the left and right motor for this tick."""
        if not math.isfinite(sum(estimate)):  # one that is not spoils the sum
            self.fail(MotorFault(faults.ESTIMATE, "the estimate is not a number"))
        self._stuck = self._stuck + 1 if estimate.dt <= 0.0 else 0
        if self._stuck >= STUCK_TICKS:
            self.fail(MotorFault(faults.CLOCK, f"the clock has not advanced for {self._stuck} ticks"))
        if estimate.t < self._last:
            self._clock_went_back()
        self._last = estimate.t
        duty = turn = 0.0
        if self.mode == STANDING_UP:
            duty = self._standing_up(estimate)
        elif self.mode == LYING_DOWN:
            duty = self._lying_down(estimate)
        if self.mode == BALANCING:  # since now, too
            self._drive.step(estimate.way, estimate.heading, estimate.t, estimate.dt)
            duty = self._balance(estimate)
            turn = self._drive.turn(estimate.heading, estimate.dt)
        if self.mode == TESTING:
            return self._testing(estimate)
        if self.mode not in ON_ITS_FEET:
            return 0.0, 0.0
        if self.mode != BALANCING:
            turn = 0.0
        return duty - turn, duty + turn

    def _testing(self, estimate: BodyEstimate) -> tuple[float, float]:
        assert self._test is not None  # of this mode
        duties = self._test.step(estimate, self._regulator, self.configured_trim)
        if duties is None:
            self.mode = IDLE
            return 0.0, 0.0
        return duties

    def _clock_went_back(self) -> None:
        """Balancing bears it; but what ends at a time (a command, a swing) might go on for as long as it went back."""
        if self.mode in (STANDING_UP, LYING_DOWN, TESTING):
            self.fail(MotorFault(faults.CLOCK, f"the clock went back while {self.mode.replace('_', ' ')}"))
        self._drive.halt()

    def _standing_up(self, estimate: BodyEstimate) -> float:
        assert self._stand_up is not None  # of this mode
        duty = self._stand_up.step(estimate)
        if self._stand_up.failure:
            self.fail(MotorFault(faults.CANNOT_STAND, self._stand_up.failure))
        elif self._stand_up.caught:
            self.mode = BALANCING
            self._since = estimate.t
            self._count, self._full_power_s = 0, 0.0
            self._trim = self.configured_trim
            self._drive.begin(estimate.way, estimate.heading)
            self._regulator.reset(self._stand_up.last_duty, estimate.tilt - self._trim)
        return duty

    def _lie(self, now: float, then: MotorFault | None) -> None:
        if self.mode != LYING_DOWN:
            self.mode, self._lie_down, self._then = LYING_DOWN, LieDown(now), None
        self._then = then or self._then

    def _lying_down(self, estimate: BodyEstimate) -> float:
        assert self._lie_down is not None  # of this mode
        duty = self._lie_down.step(estimate)
        if self._lie_down.done:
            self.mode = IDLE
            if self._then is not None:
                self.fail(self._then)
        return duty

    def _balance(self, estimate: BodyEstimate) -> float:
        tilt = estimate.tilt - self._trim
        self._count = self._count + 1 if abs(tilt) > FALLEN else 0
        if self._count >= FALLEN_TICKS:
            self._fallen(estimate.t)
            return 0.0
        demand = self._drive.demand
        way = limited(estimate.way - self._drive.way, WAY_LIMIT)
        off = Deviation(way, estimate.speed - demand.speed, tilt, estimate.tilt_rate, estimate.dt)
        duty = self._regulator.duty(off, demand)
        if abs(duty) < self._regulator.limit - _ROUNDING:
            self._full_power_s = 0.0
            if demand.speed == 0.0:
                self._learn_trim(way, estimate.dt)
        else:
            self._full_power_s += estimate.dt
            if self._full_power_s > FULL_POWER_S:
                self.fail(MotorFault(faults.LIFTED, "full power for too long: are the wheels in the air?"))
        return duty

    def _fallen(self, now: float) -> None:
        attempt = self._stand_up
        if attempt is None or not attempt.swung or now - self._since >= PROVEN_S:
            self.fail(MotorFault(faults.FELL, "fell"))
            return
        attempt.try_again(now)
        if attempt.failure:
            self.fail(MotorFault(faults.CANNOT_STAND, attempt.failure))
        else:
            self.mode = STANDING_UP

    def _learn_trim(self, way: float, dt: float) -> None:
        trim = self._trim - self._regulator.tilt_per_way * way * dt / TRIM_TIME_S
        configured = self.configured_trim
        self._trim = min(configured + TRIM_RANGE, max(configured - TRIM_RANGE, trim))
