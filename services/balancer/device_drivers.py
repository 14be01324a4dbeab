"""Drivers of the two devices the loop needs, over any `I2CBus`: transfers and pauses, no decisions.

The ATmega must be left alone for 150 us after each transfer to it. The pause is waited for at the start of the next
one, so that what happens in between (the IMU's transfer, the computation) counts.

What the control step needs is tried a second time where that costs little: after a missing acknowledge or a garbled
transfer, not after a time-out, which has taken the tick's time already.
"""

import errno
from collections.abc import Callable

from services.balancer.core.devices import balboa, imu
from services.balancer.core.slack.wire_time import Transfer
from services.balancer.i2c import I2CBus
from swarm.errors import RemoteError

IMU, ATMEGA = "IMU", "ATmega"
"""The device whose transfer failed: an OSError's `filename`."""


class Imu:
    """The LSM6DS33 or LSM6DSO."""

    def __init__(self, bus: I2CBus) -> None:
        self._bus = bus
        self.retried = 0
        """Failed transfers that were done again."""
        self.block = bytes(imu.BLOCK)
        """The bytes of the last sample, from which all axes can be read."""
        self._same = 0
        """Samples in a row that brought nothing new of one of the sensors."""

    def set_up(self) -> None:
        """Check who it is, set ranges and rates, and check that they are set. Raises OSError or `RemoteError`."""
        imu.check_identity(self._fetch(imu.WHO_AM_I, 1)[0])
        try:
            for register, value in imu.SETUP:
                self._bus.write(imu.ADDRESS, bytes((register, value)))
        except OSError as error:
            error.filename = IMU
            raise
        imu.check_setup(self._fetch(imu.CTRL1_XL, len(imu.SETUP)))

    def read(self) -> imu.ImuReading:
        """Read one sample of both sensors, in one burst. Raises OSError, or `RemoteError` where a sensor is frozen."""
        try:
            block = self._read()
        except OSError as error:
            _again(self._bus, error)
            self.retried += 1
            block = self._read()
        self._same = self._same + 1 if imu.same_sensor(block, self.block) else 0
        self.block = block
        if self._same >= imu.FROZEN:
            raise RemoteError("IMU: gyro or accelerometer is frozen: its samples bring nothing new")
        return imu.decode(block)

    def _read(self) -> bytes:
        return self._fetch(imu.OUTX_L_G, imu.BLOCK)

    def _fetch(self, register: int, count: int) -> bytes:
        try:
            return self._bus.write_read(imu.ADDRESS, bytes((register,)), count)
        except OSError as error:
            error.filename = IMU
            raise


class Balboa:
    """The ATmega32U4's buffer."""

    def __init__(
        self,
        bus: I2CBus,
        clock: Callable[[], float],
        sleep: Callable[[float], None],
        flipped: tuple[bool, bool] = (False, False),
    ) -> None:
        """`flipped` names motors, left and right, whose wires are the other way round."""
        self._bus, self._clock, self._sleep = bus, clock, sleep
        self._signs = tuple(-1.0 if each else 1.0 for each in flipped)
        self._deaf_until = 0.0
        self.retried = 0
        """Failed transfers that were done again."""

    def set_up(self) -> balboa.Housekeeping:
        """Check its layout and stop the motors; returns how it is. Raises OSError or `RemoteError`."""
        self.select(balboa.VERSION)
        balboa.check_version(self._fetch(1)[0])
        self.write_motors(0.0, 0.0)
        return self.read_housekeeping()

    def select(self, offset: int) -> None:
        """Point at `offset`: from now on reads are of the values at this moment."""
        self._write_surely(bytes((offset,)))

    def fetch_motion(self, more: int = 0) -> tuple[balboa.MotionBlock, bytes]:
        """Encoders, buttons and the watchdog's state, after `select(ENCODERS)`; and `more` bytes of what a joined index
        goes on with, or none where the transfer had to be done a second time."""
        try:
            data = self._fetch(balboa.MOTION_SIZE + more)
        except OSError as error:
            _again(self._bus, error)
            self.retried += 1
            self._write(bytes((balboa.ENCODERS,)))  # the index may stand anywhere now
            data = self._fetch(balboa.MOTION_SIZE)
        return balboa.decode_motion(data[: balboa.MOTION_SIZE]), data[balboa.MOTION_SIZE :]

    def read_housekeeping(self) -> balboa.Housekeeping:
        """Buttons, status, battery and how it fares."""
        self.select(balboa.BUTTONS)
        return balboa.decode_housekeeping(self._fetch(balboa.HOUSEKEEPING_SIZE))

    def write_motors(self, left: float, right: float) -> None:
        """Duties, -1..1; positive = forward."""
        duties = balboa.encode_motors(left * self._signs[0], right * self._signs[1])
        self._write_surely(bytes((balboa.MOTORS,)) + duties)

    def write_leds(self, red: bool, yellow: bool, green: bool) -> None:
        self._write(bytes((balboa.LEDS,)) + balboa.encode_leds(red, yellow, green))

    def transfer(self, transfer: Transfer) -> bytes:
        """Run one transfer of a task with any device; return the bytes read."""
        if transfer.address != balboa.ADDRESS:
            self._bus.write(transfer.address, transfer.data)
            return self._bus.read(transfer.address, transfer.reads) if transfer.reads else b""
        self._write(transfer.data)
        return self._fetch(transfer.reads) if transfer.reads else b""

    def settle(self) -> None:
        """Wait until the ATmega may be spoken to again."""
        self._pause()

    def _write_surely(self, data: bytes) -> None:
        try:
            self._write(data)
        except OSError as error:
            _again(self._bus, error)
            self.retried += 1
            self._write(data)

    def _write(self, data: bytes) -> None:
        self._pause()
        try:
            self._bus.write(balboa.ADDRESS, data)
        except OSError as error:
            error.filename = ATMEGA
            raise
        finally:
            self._deaf_until = self._clock() + balboa.PAUSE_S

    def _fetch(self, count: int) -> bytes:
        self._pause()
        try:
            return self._bus.read(balboa.ADDRESS, count)
        except OSError as error:
            error.filename = ATMEGA
            raise
        finally:
            self._deaf_until = self._clock() + balboa.PAUSE_S

    def _pause(self) -> None:
        left = self._deaf_until - self._clock()
        if left > 0:
            self._sleep(min(left, balboa.PAUSE_S))


def _again(bus: I2CBus, error: OSError) -> None:
    """Free the bus for a second try, or raise `error` where there is no time for one."""
    if error.errno == errno.ETIMEDOUT:
        try:
            raise error
        finally:
            del error  # it holds this frame, and the loop's process collects no circles
    bus.recover()
