"""LSM6DS33 inertial unit: registers, and raw words to SI units (ST datasheet DocID026899, sections 4.1 and 9).

The LSM6DSO has the same registers, ranges and rates; Pololu's library takes both, too.

Axes on the Balboa, when it stands: X up, Y along the axle, Z backward. Gyro Y is positive when the robot falls forward.
"""

import math
import struct
from typing import NamedTuple

from swarm.errors import RemoteError

ADDRESS = 0x6B
"""SA0 is high on the Balboa (0x6A otherwise)."""

WHO_AM_I = 0x0F
CTRL1_XL = 0x10
CTRL2_G = 0x11
CTRL3_C = 0x12
OUTX_L_G = 0x22

IDENTITY = 0x69
LSM6DSO = 0x6C
IDENTITIES = {IDENTITY: "LSM6DS33", LSM6DSO: "LSM6DSO"}
"""The parts by WHO_AM_I."""

SETUP: tuple[tuple[int, int], ...] = (
    (CTRL3_C, 0x44),  # IF_INC: a block read steps through the registers; BDU: no word changes while it is read
    (CTRL1_XL, 0x50),  # 208 Hz, +-2 g
    (CTRL2_G, 0x58),  # 208 Hz, +-1000 dps
)
"""Register values, in the order they are written."""

CONTROL = bytes(value for _, value in sorted(SETUP))
"""What CTRL1_XL to CTRL3_C hold once it is set up."""

BLOCK = 12
"""Bytes from OUTX_L_G on: gyro X Y Z, then accelerometer X Y Z, int16, low byte first."""

GYRO_SCALE = math.radians(0.035)
"""rad/s a count at 1000 dps (35 mdps)."""
STANDARD_GRAVITY = 9.80665
ACCELERATION_SCALE = 0.061e-3 * STANDARD_GRAVITY
"""m/s^2 a count at 2 g (0.061 mg)."""

FROZEN = 5
"""Samples in a row with the same three words of one of the sensors that show that it does not measure any more. Noise
of a count or more on each axis makes two such samples rare."""

_WORDS = struct.Struct("<6h")


class Rates(NamedTuple):
    """One sample of all axes of the sensor: X up, Y to the left along the axle, Z backward."""

    gyro: tuple[float, float, float]
    """rad/s, with the sensor's zero offset."""
    acceleration: tuple[float, float, float]
    """Specific force, m/s^2."""


class ImuReading(NamedTuple):
    """One sample of both sensors, of the axes the balancer uses."""

    pitch_rate: float
    """About the axle, rad/s; positive = falling forward; with the sensor's zero offset."""
    up: float
    """Specific force along the body's X axis, m/s^2: +g when it stands."""
    back: float
    """Along Z, m/s^2: +g when it lies on its front."""
    up_rate: float = 0.0
    """About the body's X axis, rad/s: turning left when it stands; with the sensor's zero offset."""
    back_rate: float = 0.0
    """About Z, rad/s: turning left when it lies on its front; with the sensor's zero offset."""


def check_identity(value: int) -> None:
    """Raises `RemoteError` where WHO_AM_I belongs to none of `IDENTITIES`."""
    if value not in IDENTITIES:
        expected = " or ".join(f"0x{identity:02X} ({name})" for identity, name in IDENTITIES.items())
        raise RemoteError(f"IMU at 0x{ADDRESS:02X}: WHO_AM_I is 0x{value:02X}, expected {expected}")


def check_setup(registers: bytes) -> None:
    """Raises `RemoteError` where CTRL1_XL to CTRL3_C do not hold what was written: ranges and rates would be others."""
    if registers != CONTROL:
        raise RemoteError(
            f"IMU at 0x{ADDRESS:02X}: CTRL1_XL to CTRL3_C hold {registers.hex(' ')}, {CONTROL.hex(' ')} was written"
        )


def same_sensor(block: bytes, before: bytes) -> bool:
    """Return whether gyro or accelerometer show exactly what they showed before."""
    half = BLOCK // 2
    return block[:half] == before[:half] or block[half:] == before[half:]


def decode(block: bytes) -> ImuReading:
    """Turn a block read into SI units.

    Raises `RemoteError` on a short block, and on one whose acceleration is exactly zero on all axes: that is no free
    fall (its noise would show) but a sensor that was reset and lost its set-up.
    """
    if len(block) != BLOCK:
        raise RemoteError(f"IMU: {len(block)} bytes instead of {BLOCK}")
    up_rate, rate, back_rate, up, side, back = _WORDS.unpack(block)
    if up == side == back == 0:
        raise RemoteError("IMU: no data, it was reset")
    return ImuReading(
        rate * GYRO_SCALE,
        up * ACCELERATION_SCALE,
        back * ACCELERATION_SCALE,
        up_rate * GYRO_SCALE,
        back_rate * GYRO_SCALE,
    )


def decode_all(block: bytes) -> Rates:
    """Decode all axes of a block that `decode` has accepted."""
    gx, gy, gz, ax, ay, az = _WORDS.unpack(block)
    return Rates(
        (gx * GYRO_SCALE, gy * GYRO_SCALE, gz * GYRO_SCALE),
        (ax * ACCELERATION_SCALE, ay * ACCELERATION_SCALE, az * ACCELERATION_SCALE),
    )


def gravity_tilt(reading: ImuReading, tilt: float = 0.0, acceleration: float = 0.0) -> float:
    """Tilt from upright by gravity, rad.

    The sensor feels gravity and its own acceleration alike: while the wheels accelerate the body, give what is known of
    that (m/s^2, forward) and the `tilt` it is felt at.
    """
    back = reading.back + acceleration * math.cos(tilt)
    up = reading.up - acceleration * math.sin(tilt)
    return math.atan2(back, up)


def turn_rate(up_rate: float, back_rate: float, tilt: float) -> float:
    """Rate about the vertical, rad/s, to the left: the vertical's shares of the two axes that lean with the body."""
    return up_rate * math.cos(tilt) + back_rate * math.sin(tilt)
