"""The I2C devices of a Balboa at the level of their registers, with a simulated body behind them.

LSM6DS33 (services/balancer/core/devices/imu.py) and ATmega32U4 (sim/core/atmega.py) as a master meets them: an IMU
that was not set up gives zeros, the ATmega stops the motors when nobody commands them. Every transfer first moves the
body on to `now`, the time of the caller's clock.
"""

import contextlib
import errno
import math
import os
import struct
from typing import NamedTuple, Protocol

from services.balancer.core.devices import balboa, display, imu
from services.balancer.core.slack.wire_time import BITS_PER_BYTE, BITS_PER_TRANSFER, HOLD_S, SCL_HZ
from sim.core.atmega import AtmegaDevice
from sim.core.balboa import BalboaBody
from sim.core.display import DisplayDevice
from swarm.core.random_numbers import RandomNumbers

NOBODY = 0x7F
"""An address that no device has."""

_WORD_LIMIT = 0x7FFF
_IF_INC = 0x04
"""Bit of CTRL3_C: each byte of a transfer is that of the next register."""
_BDU = 0x40
"""Bit of CTRL3_C: no word changes while it is read."""
_SAMPLES_HZ = 208.0
_SAMPLE = struct.Struct("<6h")


class Device(Protocol):
    """A device that answers at an address."""

    def write(self, data: bytes, now: float) -> None:
        """Take the bytes of a write transaction, at least one. Raises OSError 121 for one that is not acknowledged."""

    def read(self, count: int, now: float) -> bytes:
        """Return the bytes of a read transaction."""


class ImuErrors(NamedTuple):
    """Standard deviations of one sample, and offsets (datasheet, typical; bandwidth 104 Hz at 208 Hz)."""

    gyro_noise: float
    """rad/s."""
    gyro_offset: float
    """Offset about the axle, rad/s; the next two are about the other axes."""
    up_rate_offset: float
    back_rate_offset: float
    acceleration_noise: float
    """m/s^2."""
    up_offset: float
    back_offset: float


def draw_errors(noise: RandomNumbers) -> ImuErrors:
    """Draw one sensor's errors. Its offsets are drawn from the datasheet's typical range (10 dps; 20 of the 40 mg of
    a part soldered without trim, since a robot's `trim` is set with the sensor in it)."""
    offset = 0.020 * imu.STANDARD_GRAVITY
    return ImuErrors(
        gyro_noise=math.radians(7e-3 * math.sqrt(104)),
        gyro_offset=math.radians(noise.uniform(-10, 10)),
        up_rate_offset=math.radians(noise.uniform(-10, 10)),
        back_rate_offset=math.radians(noise.uniform(-10, 10)),
        acceleration_noise=90e-6 * math.sqrt(104) * imu.STANDARD_GRAVITY,
        up_offset=noise.uniform(-offset, offset),
        back_offset=noise.uniform(-offset, offset),
    )


NO_ERRORS = ImuErrors(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class ImuDevice:
    """An LSM6DS33, or an LSM6DSO by its `identity`, 3 cm above the axle [estimate], tilted by `trim` against the body's
    centre of mass."""

    _HEIGHT = 0.03

    def __init__(self, body: BalboaBody, noise: RandomNumbers, errors: ImuErrors, trim: float) -> None:
        self._body, self._noise, self._errors, self._trim = body, noise, errors, trim
        self.reversed: set[str] = set()
        """The ways in which it is mounted wrong: upside-down, backward or mirrored."""
        self.identity = imu.IDENTITY
        """WHO_AM_I, from the next reset on."""
        self.byte_s = BITS_PER_BYTE / SCL_HZ
        """Seconds that a byte takes on the wire. A sample that becomes ready during a read replaces the rest of the one
        before."""
        self._registers = bytearray(0x80)
        self._index = 0
        self.reset()

    def reset(self) -> None:
        """Reset as when power comes on: the sensors are off."""
        self._registers[:] = bytes(len(self._registers))
        self._registers[imu.WHO_AM_I] = self.identity
        self._registers[imu.CTRL3_C] = _IF_INC

    def write(self, data: bytes, now: float) -> None:
        """Take an index and data for the registers from there on; read-only ones keep their value."""
        del now  # configuration acts at once
        self._index = data[0] & 0x7F
        for value in data[1:]:
            if self._index in (imu.CTRL1_XL, imu.CTRL2_G, imu.CTRL3_C):
                self._registers[self._index] = value
            self._step()

    def read(self, count: int, now: float) -> bytes:
        """Registers from the index on; with IF_INC cleared, the same one again and again.

        Without block data update (BDU) a sample that is ready while the block is read replaces what is left of it, in
        the middle of a word, too. With it, words are of one sample each; that a block may be of two is left out.
        """
        if self._index < imu.OUTX_L_G + imu.BLOCK and self._index + count > imu.OUTX_L_G:
            self._sample()
            if not self._registers[imu.CTRL3_C] & _BDU:
                self._tear(count, now)
        first, end = self._index, self._index + count
        if end <= len(self._registers) and self._registers[imu.CTRL3_C] & _IF_INC:
            self._index = end & 0x7F
            return bytes(self._registers[first:end])
        result = bytearray()
        for _ in range(count):
            result.append(self._registers[self._index])
            self._step()
        return bytes(result)

    def _step(self) -> None:
        if self._registers[imu.CTRL3_C] & _IF_INC:
            self._index = (self._index + 1) & 0x7F

    def _tear(self, count: int, now: float) -> None:
        """Put the next sample in place of the bytes that are read after it was ready."""
        ready = int(((math.floor(now * _SAMPLES_HZ) + 1) / _SAMPLES_HZ - now) / self.byte_s) + 1
        if ready < count:
            end = self._index + ready
            before = bytes(self._registers[self._index : end])
            self._sample()
            self._registers[self._index : end] = before

    def _sample(self) -> None:
        """Put what the sensors feel now into the output registers, in the ranges that were set."""
        body, errors, gauss = self._body, self._errors, self._noise.gauss
        gyro = acceleration = (0, 0, 0)
        if self._registers[imu.CTRL2_G] >> 4:
            scale = _GYRO_SCALES[self._registers[imu.CTRL2_G] >> 2 & 3]
            rate = body.tilt_rate + errors.gyro_offset + gauss(0.0, errors.gyro_noise)
            # The vertical's shares of the axes that lean with the body, and with the sensor on it.
            leaning = body.tilt + self._trim
            up = body.turn_rate * math.cos(leaning) + errors.up_rate_offset + gauss(0.0, errors.gyro_noise)
            back = body.turn_rate * math.sin(leaning) + errors.back_rate_offset + gauss(0.0, errors.gyro_noise)
            gyro = (_word(up / scale), _word(rate / scale), _word(back / scale))
        if self._registers[imu.CTRL1_XL] >> 4:
            scale = _ACCELERATION_SCALES[self._registers[imu.CTRL1_XL] >> 2 & 3]
            # Specific force at the sensor, along body axes turned from the vertical by `tilt`; then its mounting.
            sin, cos, h = math.sin(body.tilt), math.cos(body.tilt), self._HEIGHT
            up = imu.STANDARD_GRAVITY * cos + body.acceleration * sin - h * body.tilt_rate**2
            back = imu.STANDARD_GRAVITY * sin - body.acceleration * cos - h * body.tilt_acceleration
            sin, cos = math.sin(self._trim), math.cos(self._trim)
            up, back = up * cos - back * sin, up * sin + back * cos
            acceleration = (
                _word((up + errors.up_offset + gauss(0.0, errors.acceleration_noise)) / scale),
                _word(gauss(0.0, errors.acceleration_noise) / scale),
                _word((back + errors.back_offset + gauss(0.0, errors.acceleration_noise)) / scale),
            )
        if self.reversed:
            signs = self._signs()
            gyro = (gyro[0] * signs[0], gyro[1] * signs[1], gyro[2] * signs[2])
            acceleration = (acceleration[0] * signs[3], acceleration[1] * signs[4], acceleration[2] * signs[5])
        _SAMPLE.pack_into(self._registers, imu.OUTX_L_G, *gyro, *acceleration)

    def _signs(self) -> tuple[int, ...]:
        """Sign of each word of a sample by how the sensor is mounted: gyro X Y Z, then acceleration X Y Z."""
        signs = [1] * 6
        for way in self.reversed:
            signs = [sign * factor for sign, factor in zip(signs, _MOUNTED[way], strict=True)]
        return tuple(signs)


_MOUNTED = {
    "upside-down": (-1, 1, -1, -1, 1, -1),
    "backward": (1, -1, -1, 1, -1, -1),
    "mirrored": (-1, -1, -1, 1, 1, 1),
}
"""Half a turn about the axle, half a turn about the body's long axis, and a gyro of the opposite sense of rotation."""


_GYRO_SCALES = tuple(math.radians(dps) for dps in (0.00875, 0.0175, 0.035, 0.070))
"""rad/s a count, by FS_G."""
_ACCELERATION_SCALES = tuple(mg * 1e-3 * imu.STANDARD_GRAVITY for mg in (0.061, 0.488, 0.122, 0.244))
"""m/s^2 a count, by FS_XL."""


def _word(value: float) -> int:
    word = round(value)
    return word if -_WORD_LIMIT <= word <= _WORD_LIMIT else _WORD_LIMIT if word > 0 else -_WORD_LIMIT


class SimulatedRobot:
    """One robot's I2C bus: dispatches transfers to the devices and counts the time they would take on the wire."""

    def __init__(self, body: BalboaBody, noise: RandomNumbers, *, errors: ImuErrors, trim: float = 0.0) -> None:
        """`trim` as in the config's [body]."""
        self.body = body
        self.scl = SCL_HZ
        """Clock of the bus, Hz. It is below the configured one if the Pi's core clock drops
        (docs/reference/robot/i2c-bus.md)."""
        self.imu = ImuDevice(body, noise, errors, trim)
        self.atmega = AtmegaDevice(body)
        self.display = DisplayDevice()
        self.devices: dict[int, Device] = {
            imu.ADDRESS: self.imu,
            balboa.ADDRESS: self.atmega,
            display.ADDRESS: self.display,
        }
        """The devices by address; a device that is taken out is absent."""
        self.sda_held = False
        """Whether a device holds SDA low in the middle of a byte: then nothing goes until nine clock pulses."""
        self.failures: list[int] = []
        """Error numbers with which the next transfers fail, 0 = this one does not."""
        self.bits = 0
        """Clock periods of SCL so far: at 100 kHz, 10 us each."""
        self._wire_s = 0.0

    def write(self, address: int, data: bytes, now: float) -> None:
        """Run a write transaction. Raises OSError as the kernel does."""
        self._reach(address, len(data), now).write(data, now)

    def read(self, address: int, count: int, now: float) -> bytes:
        """Run a read transaction. Raises OSError as the kernel does."""
        return self._reach(address, count, now).read(count, now)

    def miswire(self, part: str, *, back: bool) -> None:
        """Mount a part the wrong way (`sim.core.actions.MISWIRINGS`), or put it right."""
        side, _, what = part.partition("-")
        if side == "imu":
            (self.imu.reversed.discard if back else self.imu.reversed.add)(what)
        else:
            self.atmega.reverse(what, 0 if side == "left" else 1, reversed_=not back)

    def recover(self, now: float) -> None:
        """Read a byte from no device: its clock pulses free SDA."""
        self.sda_held = False
        with contextlib.suppress(OSError):
            self.read(NOBODY, 1, now)

    def transfer_s(self, address: int, count: int) -> float:
        """Return the duration of a transfer of `count` bytes on the wire, s: SCL's periods, and the ATmega's holds."""
        held = (1 + count) * HOLD_S if address == balboa.ADDRESS else 0.0
        return (BITS_PER_TRANSFER + BITS_PER_BYTE * (1 + count)) / self.scl + held

    def wire_s(self) -> float:
        """Return the time on the wire so far, s."""
        return self._wire_s

    def _reach(self, address: int, count: int, now: float) -> Device:
        self.atmega.advance(now)
        self.bits += BITS_PER_TRANSFER + BITS_PER_BYTE * (1 + count)
        self._wire_s += self.transfer_s(address, count)
        error = errno.ETIMEDOUT if self.sda_held else self.failures.pop(0) if self.failures else 0
        device = self.devices.get(address)
        self.imu.byte_s = BITS_PER_BYTE / self.scl
        if device is None or (device is self.atmega and self.atmega.in_bootloader):
            error = error or errno.EREMOTEIO
        if error or device is None:
            raise OSError(error, os.strerror(error))
        return device
