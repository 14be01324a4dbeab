"""Actions of a person on a simulated robot: press a button, push it, lay it down; and the datagrams that tell its body.

The world uses the same way to say where a body that is started again had been.
"""

import math

from swarm.errors import LocalError
from swarm.frozen import frozen
from swarm.messages.codec import decode, encode

BODY_SOCKET = "body.sock"

BUTTONS = ("A", "B", "C")
SIDES = ("back", "front")
DEVICES = ("imu", "atmega", "display")
MAX_IMPULSE = 2.0
"""Largest impulse in either direction, N s: five times the one that topples the robot."""
MAX_HOLD_S = 60.0
MAX_SLIDE_M = 1.0
"""Largest distance by which a robot that hits another moves it aside."""
WHEELS = ("left", "right")
MAX_ANGLE = 4 * math.tau
"""Largest angle by which a hand turns a robot or a wheel, rad."""
MISWIRINGS = (
    "left-motor", "right-motor", "left-encoder", "right-encoder", "imu-upside-down", "imu-backward", "imu-mirrored",
)  # fmt: skip
"""Parts that can be mounted the wrong way: a motor or encoder reversed, the IMU turned about an axis of the body, or
its gyro with the opposite sense of rotation."""


@frozen
class Press:
    """Hold a button down."""

    button: str
    """A, B or C."""
    seconds: float


@frozen
class Push:
    """Hit the body at the height of its centre of mass."""

    impulse: float
    """Impulse forward, N s."""


@frozen
class Knock:
    """Be hit by another robot's body."""

    impulse: float
    """Impulse forward, N s."""
    dx: float
    """The distance by which it slides aside, m."""
    dy: float


@frozen
class Lay:
    """Take the body and lay it down."""

    side: str
    """back or front."""


@frozen
class Carry:
    """Take the robot to another place and lay it on its back there."""

    x: float
    """m."""
    y: float
    heading: float
    """rad."""


@frozen
class Lift:
    """Take the robot in the hand, its wheels in the air, and hold it at a tilt; or stand it upright on the floor."""

    tilt: float
    """Tilt from upright, rad, forward positive."""
    turn: float = 0.0
    """The angle by which it is turned to the left meanwhile, rad."""
    down: bool = False
    """Put it down upright, where the hand holds it until its motors run; `tilt` and `turn` do not count then."""


@frozen
class Roll:
    """Turn a wheel by hand, of a robot that is in the hand."""

    wheel: str
    """left or right."""
    angle: float
    """rad, forward positive."""


@frozen
class Miswire:
    """Mount a part the wrong way; or put it right."""

    part: str
    """One of `MISWIRINGS`."""
    back: bool = False


@frozen
class Unplug:
    """Take a device off the I2C bus, where nobody answers for it from then on; or put it back."""

    device: str
    """imu, atmega or display."""
    back: bool = False


@frozen
class BodyPlace:
    """The place of a body when its process ended."""

    x: float
    """m."""
    y: float
    heading: float
    """rad."""
    tilt: float
    held: bool
    """Whether the robot is still in the hand that held it at the start."""


SimulationAction = Press | Push | Knock | Lay | Carry | Lift | Roll | Miswire | Unplug | BodyPlace
_NAMES: dict[str, type[SimulationAction]] = {
    "press": Press,
    "push": Push,
    "knock": Knock,
    "lay": Lay,
    "carry": Carry,
    "lift": Lift,
    "roll": Roll,
    "miswire": Miswire,
    "unplug": Unplug,
    "place": BodyPlace,
}
_OF: dict[type[SimulationAction], bytes] = {kind: name.encode() for name, kind in _NAMES.items()}


def pack(act: SimulationAction) -> bytes:
    """Return the datagram of an action: its name, a colon, its fields as msgpack."""
    return _OF[type(act)] + b":" + encode(act)


def unpack(datagram: bytes) -> SimulationAction:
    """Return the action in a datagram of `pack`. Raises `PayloadError` or `LocalError` for one that is none, or out of
    range."""
    name, _, fields = datagram.partition(b":")
    kind = _NAMES.get(name.decode("ascii", "replace"))
    if kind is None:
        raise LocalError(f"no act {name[:20]!r}, there are {', '.join(_NAMES)}")
    return check(decode(kind, fields, BODY_SOCKET))


def check(act: SimulationAction) -> SimulationAction:
    """Return the same action. Raises `LocalError` for one that is impossible."""
    match act:
        case Press(button, seconds):
            if button not in BUTTONS:
                raise LocalError(f"no button {button!r}, there are {', '.join(BUTTONS)}")
            if not 0.0 < seconds <= MAX_HOLD_S:
                raise LocalError(f"hold: expected a time above 0 up to {MAX_HOLD_S:g} s, got {seconds:g}")
        case Push(impulse):
            if not 0.0 < abs(impulse) <= MAX_IMPULSE:
                raise LocalError(f"impulse: expected at most {MAX_IMPULSE:g} N s either way, not 0, got {impulse:g}")
        case Knock(impulse, dx, dy):
            if not (abs(impulse) <= MAX_IMPULSE and abs(dx) <= MAX_SLIDE_M and abs(dy) <= MAX_SLIDE_M):
                raise LocalError(
                    f"knock: expected at most {MAX_IMPULSE:g} N s and {MAX_SLIDE_M:g} m either way, "
                    f"got {impulse:g}, {dx:g}, {dy:g}"
                )
        case Lay(side):
            if side not in SIDES:
                raise LocalError(f"no side {side!r}, there are {' and '.join(SIDES)}")
        case Lift(tilt, turn):
            if not (abs(tilt) <= math.pi and abs(turn) <= MAX_ANGLE):
                raise LocalError(f"tilt {tilt:g}, turn {turn:g}: expected at most pi, {MAX_ANGLE:.4g} rad either way")
        case Roll(wheel, angle):
            if wheel not in WHEELS:
                raise LocalError(f"no wheel {wheel!r}, there are {' and '.join(WHEELS)}")
            if not abs(angle) <= MAX_ANGLE:
                raise LocalError(f"angle: expected at most {MAX_ANGLE:.4g} rad either way, got {angle:g}")
        case Miswire(part):
            if part not in MISWIRINGS:
                raise LocalError(f"no part {part!r}, there are {', '.join(MISWIRINGS)}")
        case Unplug(device):
            if device not in DEVICES:
                raise LocalError(f"no device {device!r}, there are {', '.join(DEVICES)}")
    return act
