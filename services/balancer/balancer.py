"""One robot's balancing, tick by tick: drivers, estimator and controller, and what happens when the bus fails.

Knows no threads, no real time and no messages: the loop calls `step` a hundred times a second and the other methods in
the slack. The same object balances on the Pi, in the simulation's processes and in tests under virtual time.
"""

import logging
from collections.abc import Callable

from services.balancer.core import balboa, lqr
from services.balancer.core.body import BodyModel
from services.balancer.core.controller import FAULT, IDLE, STARTING, Controller, Regulator
from services.balancer.core.estimator import Estimate, Estimator
from services.balancer.core.gyro import GyroZero, Zero
from services.balancer.core.leds import Shown, shown
from services.balancer.drivers import Balboa, Imu
from services.balancer.i2c import I2CBus
from swarm.errors import RemoteError

TOLERATED_ERRORS = 5
"""Ticks in a row without data before it is a fault. The motors keep their last command for so long (50 ms)."""
RETRY_S = 0.5
"""Between attempts to reach the devices again."""

_log = logging.getLogger("balancer")


class Balancer:
    """See the module."""

    def __init__(
        self,
        bus: I2CBus,
        body: BodyModel,
        trim: float,
        clock: Callable[[], float],
        sleep: Callable[[float], None],
        *,
        start_mode: str = "rest",
    ) -> None:
        """`start_mode` is obeyed once the gyro's zero is known; `sleep` waits for the ATmega, 150 us at most."""
        self._bus = bus
        self.imu = Imu(bus)
        self.balboa = Balboa(bus, clock, sleep)
        self._body = body
        self._controller = Controller(Regulator(lqr.gains(body)), trim)
        self._zero = GyroZero()
        self._estimator: Estimator | None = None
        self._wish = start_mode
        self._connected = False
        self._unreachable = ""
        self._retry_at = 0.0
        self._errors_in_row = 0
        self._claim: Shown | None = None
        self._leds: Shown | None = None
        self.estimate: Estimate | None = None
        self.duty = (0.0, 0.0)
        self.battery: float | None = None
        """V."""
        self.motion = balboa.Motion(0, 0, 0, False)
        """Counters and buttons of the last tick."""
        self._bus_errors = 0

    @property
    def ready(self) -> bool:
        """Whether devices were found and the gyro's zero is known."""
        return self._estimator is not None

    @property
    def connected(self) -> bool:
        """Whether the devices answer."""
        return self._connected

    @property
    def bus_errors(self) -> int:
        """Failed transfers of the control loop since the start, those done again included."""
        return self._bus_errors + self.imu.retried + self.balboa.retried

    @property
    def mode(self) -> str:
        """starting, idle, standing_up, balancing or fault."""
        if self._unreachable:
            return FAULT
        return STARTING if not self.ready and self._controller.mode == IDLE else self._controller.mode

    @property
    def fault(self) -> str:
        """Why the motors are off; empty when there is no fault."""
        return self._controller.fault or self._unreachable

    @property
    def leds(self) -> Shown | None:
        """As they shine; None before they were first written."""
        return self._leds

    def command(self, mode: str, now: float) -> None:
        """`stand` or `rest`, at once or as soon as it is ready. Raises `LocalError` for another mode."""
        Controller.check(mode)
        self._wish, self._claim = mode, None
        self._controller.command(mode if self.ready else "rest", now)

    def claim_leds(self, leds: Shown) -> None:
        """Show what an app wants, until the next mode command."""
        self._claim = leds

    def stop(self, reason: str) -> None:
        """Motors off until the next command."""
        self._wish = "rest"
        self._controller.fail(f"stopped: {reason}")

    def step(self, now: float) -> None:
        """One tick: read, estimate, decide, command the motors. Bus failures end up in `fault`, not here."""
        if not self._connected and not self._connect(now):
            return
        try:
            self.balboa.select(balboa.ENCODERS)
            reading = self.imu.read()
            self.motion = self.balboa.fetch_motion()
            if self._estimator is None:
                zero = self._zero.add(reading, now)
                self.balboa.write_motors(0.0, 0.0)
                if zero is not None:
                    self._start(zero, now)
                self._errors_in_row = 0
                return
            self.estimate = self._estimator.update(reading, (self.motion.left, self.motion.right), now)
            self.duty = self._controller.step(self.estimate)
            self.balboa.write_motors(*self.duty)
        except (OSError, RemoteError) as error:
            self._failed(error, now)
        else:
            self._errors_in_row = 0

    def show_leds(self) -> bool:
        """Write the LEDs where they changed; for the slack. True when they did."""
        wanted = shown(self.mode, self._claim)
        if wanted == self._leds or not self._connected:
            return False
        try:
            self.balboa.write_leds(*wanted)
        except OSError:
            self._bus_errors += 1
            return False
        self._leds = wanted
        return True

    def motors_off(self) -> None:
        """The last act: stop, whatever state this is in. Where the bus fails the ATmega's watchdog does it."""
        for _ in range(3):
            try:
                self.balboa.write_motors(0.0, 0.0)
            except OSError as error:
                _log.warning("motors could not be stopped, their watchdog will: %s", error)
            else:
                self.duty = (0.0, 0.0)
                return

    def _start(self, zero: Zero, now: float) -> None:
        self._estimator = Estimator(self._body, zero)
        if self._controller.mode == IDLE:
            self._controller.command(self._wish, now)
        _log.info("gyro zero found zero=%.4f rad/s restarts=%d", zero.pitch, self._zero.restarts)

    def _connect(self, now: float) -> bool:
        if now < self._retry_at:
            return False
        self._retry_at = now + RETRY_S
        try:
            self.imu.set_up()
            found = self.balboa.set_up()
        except (OSError, RemoteError) as error:
            self._bus_errors += 1
            self._bus.recover()
            reason = _described(error)
            if reason != self._unreachable:
                _log.error("the robot's devices do not answer: %s", reason)
            self._unreachable = reason
            return False
        if self._unreachable:
            _log.info("the robot's devices answer again")
        reset = balboa.describe_reset(found.reset_cause)
        _log.info("ATmega firmware=%d last_reset=%s battery=%.2f V", found.revision, reset, found.battery)
        self.battery = found.battery
        self._connected, self._unreachable, self._leds = True, "", None
        self._errors_in_row = 0
        if self._estimator is not None:
            self._estimator.lost_track()
        return True

    def _failed(self, error: OSError | RemoteError, now: float) -> None:
        """Hold the last command for some ticks, then give up until the devices answer and a new command comes."""
        self._bus_errors += 1
        self._errors_in_row += 1
        if isinstance(error, OSError):
            self._bus.recover()
        if self._errors_in_row < TOLERATED_ERRORS:
            return
        reason = _described(error)
        _log.error("the bus failed %d ticks in a row: %s", self._errors_in_row, reason)
        self._unreachable = reason
        if self._estimator is not None:
            self._controller.fail(reason)
        self._connected, self._retry_at = False, now + RETRY_S
        self.motors_off()


def _described(error: OSError | RemoteError) -> str:
    if isinstance(error, OSError):
        return f"I2C: {error.strerror or error} (error {error.errno})"
    return str(error)
