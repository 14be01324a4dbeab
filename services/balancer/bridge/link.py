"""The messages between loop and bridge: one datagram each, a kind byte and the message as msgpack.

They share two pairs of connected Unix sockets (SOCK_SEQPACKET: whole messages in order, and the end of one side shows
at the other). One pair carries telemetry to the bridge and commands to the loop; in front of each command is the time
at which the bridge heard it. The other pair carries stops and nothing else, so that no other message delays a stop.
The loop's ends never block: what does not fit is dropped, so a bridge that hangs costs telemetry and nothing else.
"""

import struct
from typing import get_args

from services.balancer.core.devices.display import ScreenText
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
    TryMotors,
    Uwb,
)
from swarm.messages.codec import MAX_PAYLOAD, decode, encode

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
"""The messages that the loop sends."""
LoopCommand = (
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
    | TryMotors
)
"""The messages that the bridge sends."""
LoopMessage = Told | LoopCommand

TELEMETRY_S = 0.04
"""Seconds between two messages of state and odometry."""

COMMANDS_A_TICK = 8
"""Commands that the loop takes in a tick, and that the bridge hands over in as much time: a flood of commands may not
eat up the slack of a tick."""

_KINDS: dict[bytes, type[LoopMessage]] = {bytes((n,)): kind for n, kind in enumerate(get_args(LoopMessage))}
"""Numbered as they stand above: loop and bridge are always of one version, since one starts the other."""
_BYTES: dict[type[LoopMessage], bytes] = {kind: byte for byte, kind in _KINDS.items()}

_HEARD = struct.Struct("<d")

MAX_DATAGRAM = MAX_PAYLOAD + 1 + _HEARD.size


def pack(message: LoopMessage) -> bytes:
    """Return the datagram that carries `message`."""
    return _BYTES[type(message)] + encode(message)


def unpack(datagram: bytes) -> LoopMessage:
    """Return the message of a datagram; raises `PayloadError` where it is none."""
    try:
        kind = _KINDS[datagram[:1]]
    except KeyError:
        raise PayloadError(f"datagram of kind {datagram[:1]!r}: there is none") from None
    return decode(kind, datagram[1:], "link")


def pack_command(heard: float, command: LoopCommand) -> bytes:
    """Return the datagram that carries a command which the bridge heard at the time `heard`, s."""
    return _HEARD.pack(heard) + pack(command)


def unpack_command(datagram: bytes) -> tuple[float, LoopMessage]:
    """Return the command of a datagram, and when it was heard. Raises `PayloadError` where there is none."""
    if len(datagram) < _HEARD.size:
        raise PayloadError(f"command of {len(datagram)} bytes")
    return _HEARD.unpack_from(datagram)[0], unpack(datagram[_HEARD.size :])
