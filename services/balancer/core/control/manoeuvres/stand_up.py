"""Standing up: wait for a position to stand up from, then, if it lies, swing up from front or back.

look --held upright--------------------------> caught
  |  --lies still--> run_up --> swing --near upright--> caught (swung)
  |                               |  too long: look again, stronger; after the last try: failed
  +--neither for 10 s--> failed
"""

import math

from services.balancer.core.control.estimation.estimator import BodyEstimate
from services.balancer.core.control.estimation.posture import UPRIGHT, lies
from services.balancer.core.control.regulator import DUTY_LIMIT

UPRIGHT_TICKS = 5
LYING_S = 0.3
RUN_UP_S = 0.4
"""Power towards the side it lies on, so that turning round swings it up."""
SWING_S = 0.6
"""Longest swing; then the try has failed."""
CATCH = math.radians(30)
SWING_DUTIES = (DUTY_LIMIT, 0.9, 1.0)
"""Power of the first try and of the next ones: spares the motors where little is enough."""
PATIENCE_S = 10.0
"""How long it looks for a position it can stand up from."""


class StandUpAttempt:
    """One order to stand up, with all its tries."""

    def __init__(self, trim: float, now: float) -> None:
        """`trim` as in the config's [body], rad."""
        self._trim = trim
        self._tries = 0
        self._power = 0.0
        self._phase = ""
        self._since = self._phase_since = 0.0
        self._count = 0
        self.failure = ""
        """Why it was given up; empty as long as it was not."""
        self.caught = False
        """Whether it is upright, to be balanced from now on."""
        self._look(now)

    @property
    def swung(self) -> bool:
        """Whether it came up by a swing, so that a fall soon after is one more failed try."""
        return self._tries > 0

    @property
    def last_duty(self) -> float:
        """Commanded when it was caught: balancing goes on from there."""
        return math.copysign(DUTY_LIMIT, self._power) if self.swung else 0.0

    def step(self, estimate: BodyEstimate) -> float:
        """Duty of both motors for this tick; look at `caught` and `failure` afterwards."""
        now, tilt = estimate.t, estimate.tilt - self._trim
        if self._phase == "look":
            return self._looking(estimate, tilt)
        if self._phase == "run_up":
            if now - self._phase_since < RUN_UP_S:
                return -self._power
            self._phase, self._phase_since = "swing", now
        if abs(tilt) < CATCH:
            self.caught = True
            return 0.0
        if now - self._phase_since > SWING_S:
            self.try_again(now)
            return 0.0
        return self._power

    def try_again(self, now: float) -> None:
        """The last try failed, during the swing or soon after it was caught."""
        if self._tries >= len(SWING_DUTIES):
            self.failure = f"cannot stand up: {self._tries} tries failed"
        else:
            self._look(now)

    def _look(self, now: float) -> None:
        self._phase, self.caught = "look", False
        self._since = self._phase_since = now
        self._count = 0

    def _looking(self, estimate: BodyEstimate, tilt: float) -> float:
        now = estimate.t
        self._count = self._count + 1 if abs(tilt) < UPRIGHT else 0
        if self._count >= UPRIGHT_TICKS:
            self.caught = True
            self._tries = 0
        elif not lies(estimate.tilt, estimate.tilt_rate):
            self._phase_since = now
        elif now - self._phase_since > LYING_S:
            self._power = math.copysign(SWING_DUTIES[self._tries], estimate.tilt)
            self._tries += 1
            self._phase, self._phase_since = "run_up", now
            return -self._power
        if now - self._since > PATIENCE_S:
            self.failure = "cannot stand up: it neither lies still nor is held upright"
        return 0.0
