"""Acts of a person on a simulated robot: press a button, push it, lay it down; and the datagrams that tell its body.

The world uses the same way to say where a body that is started again had been.
"""

from swarm.errors import LocalError
from swarm.frozen import frozen
from swarm.messages.codec import decode, encode

BODY_SOCKET = "body.sock"

BUTTONS = ("A", "B", "C")
SIDES = ("back", "front")
DEVICES = ("imu", "atmega", "display")
MAX_IMPULSE = 2.0
"""N s, either way: five times what throws the robot over."""
MAX_HOLD_S = 60.0


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
    """Forward, N s."""


@frozen
class Lay:
    """Take the body and lay it down."""

    side: str
    """back or front."""


@frozen
class Unplug:
    """Take a device off the I2C bus, where nobody answers for it from then on; or put it back."""

    device: str
    """imu, atmega or display."""
    back: bool = False


@frozen
class BodyPlace:
    """Where the body had been when its process ended."""

    x: float
    """m."""
    y: float
    heading: float
    """rad."""
    tilt: float
    held: bool
    """Still in the hand that held it at the start."""


SimulationAction = Press | Push | Lay | Unplug | BodyPlace
_NAMES: dict[str, type[SimulationAction]] = {
    "press": Press,
    "push": Push,
    "lay": Lay,
    "unplug": Unplug,
    "place": BodyPlace,
}
_OF: dict[type[SimulationAction], bytes] = {kind: name.encode() for name, kind in _NAMES.items()}


def pack(act: SimulationAction) -> bytes:
    """The datagram: the act's name, a colon, its fields as msgpack."""
    return _OF[type(act)] + b":" + encode(act)


def unpack(datagram: bytes) -> SimulationAction:
    """The inverse of `pack`; raises `PayloadError` or `LocalError` for what is no act, or out of range."""
    name, _, fields = datagram.partition(b":")
    kind = _NAMES.get(name.decode("ascii", "replace"))
    if kind is None:
        raise LocalError(f"no act {name[:20]!r}, there are {', '.join(_NAMES)}")
    return check(decode(kind, fields, BODY_SOCKET))


def check(act: SimulationAction) -> SimulationAction:
    """The same act; raises `LocalError` where it cannot be done."""
    match act:
        case Press(button, seconds):
            if button not in BUTTONS:
                raise LocalError(f"no button {button!r}, there are {', '.join(BUTTONS)}")
            if not 0.0 < seconds <= MAX_HOLD_S:
                raise LocalError(f"hold: expected a time above 0 up to {MAX_HOLD_S:g} s, got {seconds:g}")
        case Push(impulse):
            if not 0.0 < abs(impulse) <= MAX_IMPULSE:
                raise LocalError(f"impulse: expected at most {MAX_IMPULSE:g} N s either way, not 0, got {impulse:g}")
        case Lay(side):
            if side not in SIDES:
                raise LocalError(f"no side {side!r}, there are {' and '.join(SIDES)}")
        case Unplug(device):
            if device not in DEVICES:
                raise LocalError(f"no device {device!r}, there are {', '.join(DEVICES)}")
    return act
