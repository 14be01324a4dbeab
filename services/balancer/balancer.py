"""The balancing of one robot, tick by tick: drivers, estimator and controller, and the reaction to failures of the bus.

Knows no threads, no real time and no messages: the loop calls `step` a hundred times a second and the other methods in
the slack. The same object balances on the Pi, in the simulation's processes and in tests under virtual time.
"""

import logging
import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Protocol

from services.balancer.core import faults
from services.balancer.core.control.body import BodyModel
from services.balancer.core.control.choice import make_controller
from services.balancer.core.control.controller import BALANCING, CALIBRATING, FAULT, IDLE, STARTING
from services.balancer.core.control.estimation.estimator import BodyEstimate, Estimator
from services.balancer.core.control.estimation.gyro import GyroZero, Zero
from services.balancer.core.control.estimation.posture import at_rest, posture
from services.balancer.core.devices import balboa, imu
from services.balancer.core.devices.battery import LOW, OK, BatteryGuard
from services.balancer.core.devices.leds import LedClaim, Shown, shown
from services.balancer.core.faults import MotorFault
from services.balancer.core.slack.wire_time import WireTime
from services.balancer.device_drivers import Balboa, Imu
from services.balancer.i2c import I2CBus
from swarm.config.types import Balancing
from swarm.errors import LocalError, RemoteError
from swarm.messages import TryMotors

TOLERATED_ERRORS = 5
"""Ticks in a row without data before it is a fault. The motors keep their last command for so long (50 ms)."""
RETRY_S = 0.5
"""Between attempts to reach the devices again."""
LEDS_AGAIN_S = 10.0
"""LEDs that did not change are written again after this time: an ATmega that was reset has forgotten them."""

WISH_S = 30.0
"""Seconds for which a command to stand waits for the gyro's zero. Later nobody expects the robot to move."""
MAX_NOTICE = 300
"""Letters of a notice, which has to fit into a message."""

_log = logging.getLogger("balancer")


class Passenger(Protocol):
    """A reader of some bytes of the ATmega along with the encoders, where a tick has no time for a transfer of its
    own."""

    def board(self, now: float) -> tuple[int, int]:
        """Return what to read along with this control step: the ATmega's index, and how many bytes, 0 for none."""

    def alight(self, data: bytes, now: float) -> None:
        """Take the bytes that were read. Called only where the step's transfers succeeded."""


class Balancer:
    """The balancer of one robot, stepped once a tick."""

    def __init__(
        self,
        bus: I2CBus,
        body: BodyModel,
        trim: float,
        clock: Callable[[], float],
        sleep: Callable[[float], None],
        *,
        start_mode: str = "rest",
        settings: Balancing | None = None,
        kept_zero: Zero | None = None,
    ) -> None:
        """`start_mode` is obeyed once the gyro's zero is known, which may be that of the process before (`kept_zero`);
        `sleep` waits for the ATmega, 150 us at most."""
        self.bus = bus
        self.imu = Imu(bus)
        self.wire = WireTime()
        """The durations of transfers."""
        self.passenger: Passenger | None = None
        self._clock = clock
        self._body = body
        settings = Balancing() if settings is None else settings
        self.balboa = Balboa(bus, clock, sleep, (settings.flip_left_motor, settings.flip_right_motor))
        self._controller = make_controller(body, trim, settings)
        self._guard = BatteryGuard(settings.battery_warning, settings.battery_limit)
        self._zero: GyroZero | None = GyroZero(kept=kept_zero)
        self._estimator: Estimator | None = None
        self.stopped = False
        """Whether a stop is the last that it has obeyed: no command to move has been obeyed since."""
        self._wish, self._wish_until = start_mode, math.inf
        self.connected = False
        """Whether the devices answer."""
        self._unreachable: MotorFault | None = None
        self._retry_at = 0.0
        self._errors_in_row = 0
        self.led_claim = LedClaim()
        self.leds: Shown | None = None
        """The LEDs as they are lit; None before they were first written."""
        self._leds_again_at = 0.0
        self.notices: deque[tuple[str, str]] = deque(maxlen=8)
        """Events that are no fault, as (about what, text), until somebody asks."""
        self.estimate: BodyEstimate | None = None
        self.duty = (0.0, 0.0)
        self.battery: float | None = None
        """The battery's voltage, V; None before it was read, and where the last reading is too old."""
        self.firmware: tuple[int, int] | None = None
        """Layout and revision of the ATmega's; None before it was found."""
        self.motion = balboa.MotionBlock(0, 0, 0, False)
        """Counters and buttons of the last tick."""
        self._bus_errors = 0

    @property
    def ready(self) -> bool:
        """Whether devices were found and the gyro's zero is known."""
        return self._estimator is not None

    @property
    def gyro_zero(self) -> Zero | None:
        """Return the gyro's zero in use; None before it was found."""
        return None if self._estimator is None else self._estimator.gyro_zero

    @property
    def bus_errors(self) -> int:
        """Failed transfers of the control loop since the start, those done again included."""
        return self._bus_errors + self.imu.retried + self.balboa.retried

    @property
    def mode(self) -> str:
        """starting, calibrating, idle, standing_up, balancing, lying_down, testing or fault."""
        if self._unreachable is not None:
            return FAULT
        if self._controller.mode != IDLE or self._zero is None:
            return self._controller.mode
        return CALIBRATING if self.connected else STARTING

    @property
    def fault(self) -> MotorFault | None:
        """Why the motors are off; None when there is no fault."""
        return self._controller.fault or self._unreachable

    @property
    def posture(self) -> str:
        """upright, front, back or leaning; unknown before the first estimate."""
        return "unknown" if self.estimate is None else posture(self.estimate.tilt, self._controller.configured_trim)

    @property
    def demand(self) -> tuple[float, float]:
        """Speed and turn rate it drives with, m/s and rad/s."""
        return self._controller.demand

    @property
    def parameters(self) -> Mapping[str, float]:
        """Return the present values of the parameters that may be changed while it runs."""
        return self._controller.parameters

    @property
    def battery_level(self) -> str:
        """ok, low, empty or unknown."""
        return self._guard.level

    @property
    def battery_time_left(self) -> float | None:
        """s until it lies down, roughly; None where that is not known."""
        return self._guard.time_left(moving=self.mode == BALANCING)

    def command(self, mode: str, now: float) -> None:
        """`stand` or `rest`, at once or as soon as it is ready; `lie` and `calibrate` where they can be done now.

        Raises `LocalError` where the command is none, or cannot be obeyed.
        """
        self._controller.check(mode)
        if mode != "rest" and self._unreachable is not None:
            raise LocalError(f"mode {mode}: the robot's devices do not answer ({self._unreachable.reason})")
        if mode == "stand" and (fault := self._guard.fault) is not None:
            raise LocalError(f"mode stand: {fault.reason}: {fault.recovery}")
        if mode == "calibrate":
            self._calibrate()
        elif mode == "lie":
            self._controller.command(mode, now)
            self.led_claim.clear()
            self.stopped = False
        else:
            self._wish, self._wish_until = mode, now + WISH_S
            self.led_claim.clear()
            if self.ready and mode == "stand":
                self._zero = None  # a calibration under way is given up: the zero of before holds
            self._controller.command(mode if self.ready else "rest", now)
            self.stopped = self.stopped and mode == "rest"

    def notice(self, about: str, text: str) -> None:
        """Tell people something about a command, a little later."""
        self.notices.append((about, text[:MAX_NOTICE]))

    def drive(self, speed: float, turn_rate: float, seconds: float, now: float) -> None:
        """Drive forward (m/s) and turn left (rad/s) for a time; a value above its limit is cut, and that is told.

        Raises `LocalError` where it is no number, holds for too long, or the robot does not balance.
        """
        cut = self._controller.drive(speed, turn_rate, seconds, now)
        if cut:
            self.notices.append(("velocity", cut))

    def test_motors(self, request: TryMotors, now: float) -> None:
        """Turn the wheels at low power for a time, without balancing; raises `LocalError` where it is not idle."""
        if not self.ready or self.mode == FAULT:
            raise LocalError(f"motors: only an idle robot tests them, this one is {self.mode}: swarm balance rest")
        self._controller.test_motors(request, now)
        self.stopped = False

    def change(self, parameters: Mapping[str, float]) -> None:
        """Change parameters, all or none; raises `LocalError` that names the first that cannot be."""
        self._controller.change(parameters)

    def claim_leds(self, leds: Shown, seconds: float, now: float, at: float | None = None) -> None:
        """Show what an app wants, for a time or until the next mode command; from the time `at` on, or at once.

        Raises `LocalError` for a wrong time, or where too many orders wait for theirs.
        """
        self.led_claim.order(leds, seconds, now, at)

    def stop(self, reason: str) -> bool:
        """Motors off until the next command; True where that is new."""
        self.stopped = True
        self._wish = "rest"
        return self._controller.fail(MotorFault(faults.STOPPED, f"stopped: {reason}"))

    def step(self, now: float) -> None:
        """Run one tick: read, estimate, decide, command the motors. Failures of the bus lead to `fault`, not to
        errors."""
        if not self.connected and not self._connect(now):
            return
        try:
            reading = self._read(now)
            if self._zero is not None:
                self._seek_zero(self._zero, reading, now)
            if self._estimator is None:
                self.balboa.write_motors(0.0, 0.0)
                self._errors_in_row = 0
                return
            self.estimate = self._estimator.update(reading, (self.motion.left, self.motion.right), now)
            self.duty = self._controller.step(self.estimate)
            if not self._controller.silent:
                self.balboa.write_motors(*self.duty)
        except (OSError, RemoteError) as error:
            self._failed(error, now)
        else:
            self._errors_in_row = 0

    def _read(self, now: float) -> imu.ImuReading:
        """Read all inputs of a tick; the duration tells how fast the bus is."""
        index, more = (balboa.ENCODERS, 0) if self.passenger is None else self.passenger.board(now)
        retried = self.imu.retried + self.balboa.retried
        self.balboa.settle()  # pauses are no part of what is timed
        begun = self._spent()
        self.balboa.select(index)
        selected = self._spent()
        reading = self.imu.read()
        sampled = self._spent()
        self.balboa.settle()
        settled = self._spent()
        self.motion, found = self.balboa.fetch_motion(more)
        if self.imu.retried + self.balboa.retried == retried:
            self.wire.learn(selected - begun, sampled - selected, balboa.MOTION_SIZE + more, self._spent() - settled)
        if self.passenger is not None and found:
            self.passenger.alight(found, now)
        return reading

    def _spent(self) -> float:
        """Return the clock, with what a simulated bus counts instead of taking it."""
        return self._clock() + self.bus.untimed()

    def watch_battery(self, now: float) -> None:
        """Judge the battery by its last reading: warn, or lie down; for the slack, once a second."""
        if not self._guard.update(self.battery, now):
            return
        if (fault := self._guard.fault) is not None:
            self._wish = "rest"
            self._controller.lie_down(now, fault)
        elif self._guard.level == LOW:
            volts = f"{self._guard.volts:.1f} V"
            _log.warning("battery low: %s", volts)
            self.notices.append(("battery", f"low: {volts}, the robot lies down at {self._guard.limit:.1f} V"))

    def leds_wanted(self, now: float) -> Shown | None:
        """Return the LEDs to write at `now`; None where they are lit so already."""
        wanted = shown(
            self.mode,
            "" if self.fault is None else self.fault.name,
            self.led_claim.leds(now),
            low_battery=self._guard.level != OK,
            now=now,
        )
        return None if wanted == self.leds and now < self._leds_again_at else wanted

    def show_leds(self, now: float) -> bool:
        """Write the LEDs as they shall be at `now`, where they changed, and now and then; for the slack. True when they
        were written."""
        wanted = self.leds_wanted(now)
        if not self.connected or wanted is None:
            return False
        try:
            self.balboa.write_leds(*wanted)
        except OSError:
            self._bus_errors += 1
            return False
        self.leds, self._leds_again_at = wanted, now + LEDS_AGAIN_S
        return True

    def motors_off(self) -> None:
        """Stop the motors as the last act, whatever the state. Where the bus fails, the ATmega's watchdog does it."""
        for _ in range(3):
            try:
                self.balboa.write_motors(0.0, 0.0)
            except OSError as error:
                _log.warning("motors could not be stopped, their watchdog will: %s", error)
            else:
                self.duty = (0.0, 0.0)
                return

    def _calibrate(self) -> None:
        """Look for the gyro's zero anew; it is given up, and that is told, when the robot moves meanwhile."""
        if not self.ready or self._controller.mode != IDLE:
            raise LocalError(f"mode calibrate: the robot must be idle, this one is {self.mode}")
        if self.estimate is None or not at_rest(self.estimate):
            raise LocalError("mode calibrate: the robot must be at rest, this one is moving")
        self._zero = GyroZero(settle_s=0.0)

    def _seek_zero(self, search: GyroZero, reading: imu.ImuReading, now: float) -> None:
        restarts = search.restarts
        zero = search.add(reading, now)
        if zero is not None:
            self._zero = None
            self._start(zero, now)
            _log.info("gyro zero found zero=%.4f rad/s restarts=%d", zero.pitch, restarts)
        elif search.restarts > restarts:
            if self.ready:
                self._zero = None
                self.notices.append(("calibrate", "given up: the robot was moved; the gyro's zero of before holds"))
            elif search.restarts % 20 == 1:
                self.notices.append(("calibrate", "the robot is moved: leave it alone for a second"))

    def _start(self, zero: Zero, now: float) -> None:
        if self._estimator is not None:
            self._estimator.gyro_zero = zero
            self.notices.append(("calibrate", "done"))
            return
        self._estimator = Estimator(self._body, zero)
        if self._controller.mode == IDLE and self._wish == "stand" and now > self._wish_until:
            self.notice("mode", f"stand: given up, the gyro's zero was not found within {WISH_S:g} s: command it again")
        elif self._controller.mode == IDLE:
            self._controller.command(self._wish, now)

    def _connect(self, now: float) -> bool:
        if now < self._retry_at:
            return False
        self._retry_at = now + RETRY_S
        try:
            self.imu.set_up()
            found = self.balboa.set_up()
        except (OSError, RemoteError) as error:
            self._bus_errors += 1
            self.bus.recover()
            fault = _described(error)
            if fault != self._unreachable:
                _log.error("the robot's devices do not answer: %s", fault.reason)
            self._unreachable = fault
            return False
        if self._unreachable is not None:
            _log.info("the robot's devices answer again")
        reset = balboa.describe_reset(found.reset_cause)
        _log.info("ATmega firmware=%d last_reset=%s battery=%.2f V", found.revision, reset, found.battery)
        self.battery, self.firmware = found.battery, (balboa.LAYOUT_VERSION, found.revision)
        self.connected, self._unreachable, self.leds = True, None, None
        self._errors_in_row = 0
        if self._estimator is not None:
            self._estimator.lost_track()
        return True

    def _failed(self, error: OSError | RemoteError, now: float) -> None:
        """Hold the last command for some ticks, then give up until the devices answer and a new command comes."""
        self._bus_errors += 1
        self._errors_in_row += 1
        if isinstance(error, OSError):
            self.bus.recover()
        if self._errors_in_row < TOLERATED_ERRORS:
            if self._controller.mode in (IDLE, FAULT) and self.duty != (0.0, 0.0):  # stopped meanwhile
                self.motors_off()
            return
        fault = _described(error)
        _log.error("the bus failed %d ticks in a row: %s", self._errors_in_row, fault.reason)
        self._unreachable = fault
        self._controller.fail(fault)
        self.connected, self._retry_at = False, now + RETRY_S
        self.motors_off()


def _described(error: OSError | RemoteError) -> MotorFault:
    if isinstance(error, OSError):
        return MotorFault(faults.BUS, f"I2C, {error.filename}: {error.strerror} (error {error.errno})")
    return MotorFault(faults.DEVICE, str(error))
