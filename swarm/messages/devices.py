"""Messages of the balancer about the devices on its bus."""

from swarm.frozen import frozen
from swarm.messages.codec import Measured, with_telemetry


@frozen
class UwbRange:
    """The distance to one module, as the DWM1001 reported it."""

    anchor: str
    """Short UWB address as printed on the module, e.g. C933."""
    distance: Measured
    """The raw distance in whole millimetres, m."""
    quality: int
    """Quality of the range, 0-100."""
    x: Measured
    """The place at which that module was set up, m."""
    y: Measured
    z: Measured
    place_quality: int
    """0-100; 0 = it was not set up."""


@frozen
class Uwb:
    """The ATmega's UWB block, on `swarm/<robot>/balancer/uwb`: on each new report, and once a second without any."""

    t: float
    """The time at which the balancer read the block, s."""
    state: str
    """The ATmega's last poll of the module: ok, silent, refused, broken or paused (for the mailbox)."""
    error: int
    """The module's error code of its last refusal; 0 = none so far."""
    bad: int
    """Polls with an incomplete answer since the balancer found the ATmega."""
    sequence: int
    """The number of reports since the balancer started. 0: there is no report yet, and all other fields are zero."""
    lost: int
    """Reports that came to the ATmega and were not read in time, since the balancer started."""
    age: Measured
    """Seconds since the ATmega got the report, at `t`; 65.535 = that or more."""
    x: Measured
    """The robot's place as the module computes it, m."""
    y: Measured
    z: Measured
    quality: int
    """0-100; 0 = no fix, and the coordinates are old ones or zero."""
    count: int
    """Modules in sight; `ranges` has the first four of them."""
    ranges: tuple[UwbRange, ...]


MODULE_CALLS = {
    0x01: 13, 0x02: 0, 0x03: 4, 0x04: 0, 0x05: 2, 0x07: 2, 0x08: 0, 0x0C: 0, 0x14: 0, 0x15: 0, 0x30: 0, 0x32: 0,
}  # fmt: skip
"""The calls of a DWM1001 that may come over the bus: bytes of the value by type. None of them erases a module, or puts
it to sleep (docs/reference/robot/uwb-module.md)."""


@frozen
class ModuleRequest:
    """Command on `balancer/set/module`: one request to the DWM1001."""

    ticket: str
    """The name of the request, which the answer repeats. The current request and the last one answered are not carried
    out twice."""
    request: bytes
    """Type, length and value as in the DWM1001's generic mode: 2 to 255 bytes."""


@frozen
class ModuleAnswer:
    """The answer of the DWM1001, on `balancer/module`."""

    t: float
    ticket: str
    answer: bytes
    """Status and data parts, `40 01 err ...`; or the bytes that arrived instead, if `problem` says so."""
    problem: str
    """Why there is no proper answer; empty if there is one, which may be a refusal by the module."""


@frozen
class Battery:
    """The battery's state, on `balancer/battery` at 1 Hz."""

    t: float
    voltage: float
    """The battery's voltage, V."""


@frozen
class Firmware:
    """The firmware that the ATmega runs, on `balancer/firmware` at 1 Hz."""

    t: float
    layout: int
    """Version of the firmware's layout on the I2C bus."""
    revision: int
    """Release of the firmware."""


@frozen
class Buttons:
    """The state of the buttons, on `balancer/buttons`: on each change, and once a second."""

    t: float
    a: bool
    """Whether the button is pressed."""
    b: bool
    c: bool
    presses_a: int
    """Presses of A since the balancer started. A program that has missed a press sees it here."""
    presses_b: int
    presses_c: int

    @property
    def presses(self) -> tuple[int, int, int]:
        """The presses of A, B and C."""
        return self.presses_a, self.presses_b, self.presses_c


@frozen
class ImuRequest:
    """Command on `balancer/set/imu`: tell the IMU's samples for a while."""

    rate: float
    """Samples a second: above 0, at most 100."""
    duration: float
    """Seconds for which samples are published, at most 60; 0 ends an earlier request."""


@frozen
class ImuSample:
    """One sample of the IMU, on `balancer/imu` while somebody has asked for it: X up, Y to the left along the axle,
    Z backward."""

    t: float
    """The time of the control step that read it, s."""
    sequence: int
    """The number of these messages so far."""
    gyro: tuple[float, ...]
    """rad/s, three axes, with the sensor's zero offset."""
    acceleration: tuple[float, ...]
    """Specific force, m/s^2, three axes."""


@frozen
class Note:
    """One note of a melody."""

    frequency: float
    """Hz, 16 to 8000, played as the nearest semitone; 0 = a rest."""
    duration: float
    """s, 0.01 to 2.55."""
    volume: float
    """0 to 1."""


@frozen
class SetNotes:
    """Command on `balancer/set/notes`: play this instead of whatever plays; nothing = silence."""

    notes: tuple[Note, ...]
    """The notes, 64 at most."""


@frozen
class SetDisplay:
    """Command on `balancer/set/display`: text in place of the app's values."""

    text: str
    """Four lines of 21 letters (ASCII) are shown, longer ones are wrapped; empty = the app's values again."""
    seconds: float | None = None
    """Seconds after which the app's values are shown again; None: the text stays until another one arrives."""


@frozen
class Display:
    """The text on the robot's display, on `balancer/display`: on change, when it is drawn."""

    t: float
    present: bool
    """Whether there is a display; without one the lines are what it would show."""
    lines: tuple[str, ...]
    """The first one is large."""


@frozen
class MeasureI2C:
    """Command on `balancer/set/i2c`: time reads from and writes to the ATmega, in the slack of the ticks."""

    ticket: str
    """Names the request; the answer carries it."""
    size: int
    """Bytes of a transfer, 1 to 28, without the index."""
    count: int
    """Transfers of each kind, 1 to 1000."""


@frozen
class I2CRates:
    """The answer, on `balancer/i2c`."""

    t: float
    ticket: str
    size: int
    count: int
    """Transfers of each kind that were timed."""
    failed: int
    """Transfers that failed; they are not in the rates."""
    read: float | None
    """Rate of reading, bit/s of data, with the selection of the index and both pauses; None if no read succeeded."""
    write: float | None
    """Rate of writing, bit/s of data, with the pause."""
    problem: str
    """Why the measurement was given up; empty otherwise."""


TOPICS = with_telemetry(
    {
        ("balancer", "uwb"): Uwb,
        ("balancer", "module"): ModuleAnswer,
        ("balancer", "set/module"): ModuleRequest,
        ("balancer", "battery"): Battery,
        ("balancer", "firmware"): Firmware,
        ("balancer", "buttons"): Buttons,
        ("balancer", "imu"): ImuSample,
        ("balancer", "set/imu"): ImuRequest,
        ("balancer", "set/notes"): SetNotes,
        ("balancer", "set/display"): SetDisplay,
        ("balancer", "display"): Display,
        ("balancer", "set/i2c"): MeasureI2C,
        ("balancer", "i2c"): I2CRates,
    }
)
"""Message type of each key, by (service, topic)."""
