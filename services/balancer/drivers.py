"""Drivers of the two devices the loop needs, over any `I2CBus`: transfers and pauses, no decisions.

The ATmega must be left alone for 150 us after each transfer to it. The pause is waited for at the start of the next
one, so that what happens in between (the IMU's transfer, the computation) counts.
"""

from collections.abc import Callable

from services.balancer.core import balboa, imu
from services.balancer.i2c import I2CBus


class Imu:
    """The LSM6DS33."""

    def __init__(self, bus: I2CBus) -> None:
        self._bus = bus

    def set_up(self) -> None:
        """Check who it is and set ranges and rates. Raises OSError or `RemoteError`."""
        imu.check_identity(self._bus.write_read(imu.ADDRESS, bytes((imu.WHO_AM_I,)), 1)[0])
        for register, value in imu.SETUP:
            self._bus.write(imu.ADDRESS, bytes((register, value)))

    def read(self) -> imu.Reading:
        """One sample of both sensors, in one burst."""
        return imu.decode(self._bus.write_read(imu.ADDRESS, bytes((imu.OUTX_L_G,)), imu.BLOCK))


class Balboa:
    """The ATmega32U4's buffer."""

    def __init__(self, bus: I2CBus, clock: Callable[[], float], sleep: Callable[[float], None]) -> None:
        self._bus, self._clock, self._sleep = bus, clock, sleep
        self._deaf_until = 0.0

    def set_up(self) -> None:
        """Check its layout and stop the motors. Raises OSError or `RemoteError`."""
        self.select(balboa.VERSION)
        balboa.check_version(self._fetch(1)[0])
        self.write_motors(0.0, 0.0)

    def select(self, offset: int) -> None:
        """Point at `offset`: from now on reads are of the values at this moment."""
        self._write(bytes((offset,)))

    def fetch_encoders(self) -> tuple[int, int]:
        """The counters, after `select(ENCODERS)`."""
        return balboa.decode_encoders(self._fetch(4))

    def read_housekeeping(self) -> balboa.Housekeeping:
        """Buttons, status and battery."""
        self.select(balboa.BUTTONS)
        return balboa.decode_housekeeping(self._fetch(balboa.HOUSEKEEPING_SIZE))

    def write_motors(self, left: float, right: float) -> None:
        """Duties, -1..1."""
        self._write(bytes((balboa.MOTORS,)) + balboa.encode_motors(left, right))

    def write_leds(self, red: bool, yellow: bool, green: bool) -> None:
        """Switch the LEDs."""
        self._write(bytes((balboa.LEDS,)) + balboa.encode_leds(red, yellow, green))

    def _write(self, data: bytes) -> None:
        self._pause()
        try:
            self._bus.write(balboa.ADDRESS, data)
        finally:
            self._deaf_until = self._clock() + balboa.PAUSE_S

    def _fetch(self, count: int) -> bytes:
        self._pause()
        try:
            return self._bus.read(balboa.ADDRESS, count)
        finally:
            self._deaf_until = self._clock() + balboa.PAUSE_S

    def _pause(self) -> None:
        left = self._deaf_until - self._clock()
        if left > 0:
            self._sleep(min(left, balboa.PAUSE_S))
