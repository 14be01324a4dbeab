"""Motors at low power without balancing: what `swarm commission` tries on a robot that a person holds in the hand.

No test exceeds `LIMIT` of duty or `LONGEST_S`, whatever is asked for, and each ends by itself. Nothing of it needs
right signs: a motor, an encoder or an IMU that is mounted the wrong way turns wheels slowly the wrong way.
"""

import math

from services.balancer.core.control.estimation.estimator import BodyEstimate
from services.balancer.core.control.regulator import STANDSTILL, Deviation, Regulator, limited
from swarm.errors import LocalError
from swarm.messages import TryMotors

LIMIT = 0.2
"""Duty: a wheel turns with a fifth of its free speed, and a hand stops it."""
LONGEST_S = 10.0

TURN = "turn"
WATCHDOG = "watchdog"
TILT = "tilt"
KINDS = (TURN, WATCHDOG, TILT)


def check_test(request: TryMotors) -> None:
    """Raises `LocalError` for a test that is none, or exceeds a limit."""
    if request.kind not in KINDS:
        raise LocalError(f"kind {request.kind[:20]!r}: expected one of {', '.join(KINDS)}")
    for name, duty in (("left", request.left), ("right", request.right)):
        if not abs(duty) <= LIMIT:
            raise LocalError(f"{name}: duty {duty:g}, expected at most {LIMIT:g} either way")
    if not 0.0 < request.seconds <= LONGEST_S:
        raise LocalError(f"seconds: {request.seconds:g}, expected a time above 0 up to {LONGEST_S:g} s")


class MotorTest:
    """One test, from its first tick until its time is over."""

    def __init__(self, request: TryMotors, now: float) -> None:
        """`request` as `check_test` has accepted it."""
        self._request = request
        self._until = now + request.seconds
        self._ticks = 0

    @property
    def silent(self) -> bool:
        """Whether the motors get no command in this tick, so that the ATmega's watchdog has to stop them."""
        return self._request.kind == WATCHDOG and self._ticks > 1

    def step(self, estimate: BodyEstimate, regulator: Regulator, trim: float) -> tuple[float, float] | None:
        """Return the duties of the left and right motor for this tick; None once the test is over."""
        if not estimate.t < self._until:
            return None
        self._ticks += 1
        request = self._request
        if request.kind != TILT:
            return request.left, request.right
        if self._ticks == 1:
            regulator.reset(0.0, estimate.tilt - trim)
        # The wheels are in the air: what they have rolled says nothing of where the robot is.
        off = Deviation(0.0, 0.0, estimate.tilt - trim, estimate.tilt_rate, estimate.dt)
        duty = limited(regulator.duty(off, STANDSTILL), LIMIT)
        return (duty, duty) if math.isfinite(duty) else (0.0, 0.0)
