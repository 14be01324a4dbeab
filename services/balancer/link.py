"""What the loop and the bridge tell each other: one datagram a message, a kind byte and the message as msgpack.

They share a pair of connected Unix sockets (SOCK_SEQPACKET: whole messages in order, and the end of one side shows at
the other). The loop's end never blocks: what does not fit is dropped, so a bridge that hangs costs telemetry and
nothing else.
"""

from typing import get_args

from services.balancer.core.display import ScreenText
from swarm.codec import MAX_PAYLOAD, decode, encode
from swarm.errors import PayloadError
from swarm.messages import (
    BalancerFault,
    BalancerState,
    Battery,
    Buttons,
    Display,
    Firmware,
    I2CRates,
    ImuRequest,
    ImuSample,
    Leds,
    MeasureI2C,
    ModuleAnswer,
    ModuleRequest,
    Notice,
    Odometry,
    Parameters,
    SetLeds,
    SetMode,
    SetNotes,
    SetParameters,
    SetVelocity,
    Stop,
    Uwb,
)

Told = (
    BalancerState
    | Odometry
    | Leds
    | BalancerFault
    | Notice
    | Parameters
    | Battery
    | Buttons
    | Uwb
    | ModuleAnswer
    | ImuSample
    | Display
    | I2CRates
    | Firmware
)
"""By the loop."""
Command = (
    SetMode
    | SetVelocity
    | SetParameters
    | SetLeds
    | Stop
    | ModuleRequest
    | ImuRequest
    | SetNotes
    | ScreenText
    | MeasureI2C
)
"""By the bridge."""
Message = Told | Command

_KINDS: dict[bytes, type[Message]] = {bytes((n,)): kind for n, kind in enumerate(get_args(Message))}
"""Numbered as they stand above: loop and bridge are always of one version, since one starts the other."""
_BYTES: dict[type[Message], bytes] = {kind: byte for byte, kind in _KINDS.items()}

MAX_DATAGRAM = MAX_PAYLOAD + 1


def pack(message: Message) -> bytes:
    """The datagram that carries `message`."""
    return _BYTES[type(message)] + encode(message)


def unpack(datagram: bytes) -> Message:
    """The message of a datagram; raises `PayloadError` where it is none."""
    try:
        kind = _KINDS[datagram[:1]]
    except KeyError:
        raise PayloadError(f"datagram of kind {datagram[:1]!r}: there is none") from None
    return decode(kind, datagram[1:], "link")
