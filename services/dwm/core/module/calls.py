"""The module's other calls (DWM1001 API guide 2.2, chapter 5): settings, update rates, versions, status, reset.

A call is built here, sent as `call.request` and answered as `tlv.Decoder(call)` reads it. The tables of bits are those
of Decawave's host API sources. What the module keeps in flash (mode, anchor or tag) is in force after `reset`.
"""

import struct

from services.dwm.core.module.tlv import (
    LOC_GET,
    POSITION_PART,
    AnswerPart,
    ModuleCall,
    Position,
    decode_position,
    encode_part,
    encode_position,
)
from swarm.errors import FrameError, LocalError
from swarm.frozen import frozen
from swarm.messages.devices import MODULE_CALLS

POS_SET, TAG_SET, ANCHOR_SET, RATE_SET = 0x01, 0x05, 0x07, 0x03
"""Types of the requests that carry a value."""

RATE_UNIT = 0.1
"""Unit of the period in which update rates are given, s: 1 stands for 10 Hz."""
SLOWEST = 600
"""The longest period in this unit: a minute (API guide, dwm_upd_rate_set: 0.1 s to 60 s)."""

UWB_OFF, UWB_PASSIVE, UWB_ACTIVE = 0, 1, 2
"""UWB modes: a module that is not active is not ranged to and ranges to nobody."""

UPDATE_RATE, CONFIG, NODE_ID, FIRMWARE, CONFIG_VERSION, HARDWARE, STATUS = 0x45, 0x46, 0x4E, 0x50, 0x51, 0x52, 0x5A
"""Types of the answers' parts."""

_RATES = struct.Struct("<HH")
_LOW_POWER, _ENGINE, _ENCRYPTION, _LEDS, _BLUETOOTH, _UPDATE = 1 << 7, 1 << 6, 1 << 5, 1 << 4, 1 << 3, 1 << 2
_INITIATOR, _BRIDGE = 1 << 7, 1 << 6  # first byte of cfg_anchor_set
_IS_ANCHOR, _IS_INITIATOR, _IS_BRIDGE, _STATIONARY = 1 << 5, 1 << 4, 1 << 3, 1 << 2  # second byte of cfg_get


@frozen
class UpdateRate:
    """The rate at which a tag measures."""

    moving: int
    """Period while it moves, in units of 0.1 s."""
    still: int
    """Period while its accelerometer says that it stands still, where stationary detection is on; the module comes
    with 100, 10 s."""


@frozen
class Settings:
    """The settings that `cfg_get` tells, and `cfg_tag_set` or `cfg_anchor_set` change. Some hold for tags alone,
    some for anchors alone; the module ignores the others."""

    anchor: bool
    initiator: bool = False
    """Anchor: starts the network; one anchor must, a second one in reach steps back."""
    bridge: bool = False
    low_power: bool = False
    """Tag: sleeps between measurements, and then needs to be woken by three bytes."""
    engine: bool = True
    """Tag: computes its place."""
    stationary: bool = False
    """Tag: measures at the slow rate while it stands still. A balanced robot does."""
    encrypted: bool = False
    leds: bool = True
    bluetooth: bool = True
    update: bool = False
    """Takes new firmware over the air."""
    uwb: int = UWB_ACTIVE
    measurement: int = 0
    """0 = two-way ranging, the only mode there is."""


@frozen
class Version:
    """The answer of `ver_get`."""

    firmware: tuple[int, int, int, int]
    """major, minor, patch, variant: PANS R2 is 1.3.0."""
    config: int
    hardware: int

    @property
    def text(self) -> str:
        """The firmware's version as the maker writes it."""
        return ".".join(map(str, self.firmware[:3]))


@frozen
class ModuleStatus:
    """The answer of `status_get`."""

    located: bool
    """Whether there is a new location since the last `loc_get`."""
    joined: bool
    """Whether the module belongs to a network, so that an initiator is in reach."""


def pos_set(place: Position) -> ModuleCall[None]:
    """Set an anchor's place; kept in flash. Raises `LocalError` for values that the fields do not hold."""
    return _command("pos_set", encode_part(POS_SET, encode_position(place)))


def upd_rate_set(rate: UpdateRate) -> ModuleCall[None]:
    """Set how often a tag measures; kept in flash, in force at once."""
    for period in (rate.moving, rate.still):
        if not 1 <= period <= SLOWEST:
            raise LocalError(f"update period {period * RATE_UNIT:g} s: expected {RATE_UNIT:g} to 60 s")
    return _command("upd_rate_set", encode_part(RATE_SET, _RATES.pack(rate.moving, rate.still)))


def cfg_set(settings: Settings) -> ModuleCall[None]:
    """Make the module a tag or an anchor; in force after `RESET`."""
    first = _common(settings)
    if settings.anchor:
        first |= _INITIATOR * settings.initiator | _BRIDGE * settings.bridge
        return _command("cfg_anchor_set", encode_part(ANCHOR_SET, bytes((first, 0))))
    first |= _LOW_POWER * settings.low_power | _ENGINE * settings.engine
    second = _STATIONARY * settings.stationary | settings.measurement & 3
    return _command("cfg_tag_set", encode_part(TAG_SET, bytes((first, second))))


def encode_settings(settings: Settings) -> bytes:
    """Return the two bytes of the answer to `cfg_get`."""
    first = _common(settings) | _LOW_POWER * settings.low_power | _ENGINE * settings.engine
    second = _IS_ANCHOR * settings.anchor | _IS_INITIATOR * settings.initiator | _IS_BRIDGE * settings.bridge
    return bytes((first, second | _STATIONARY * settings.stationary | settings.measurement & 3))


def decode_settings(value: bytes) -> Settings:
    """Decode the settings of `cfg_get`."""
    first, second = value
    return Settings(
        anchor=bool(second & _IS_ANCHOR),
        initiator=bool(second & _IS_INITIATOR),
        bridge=bool(second & _IS_BRIDGE),
        low_power=bool(first & _LOW_POWER),
        engine=bool(first & _ENGINE),
        stationary=bool(second & _STATIONARY),
        encrypted=bool(first & _ENCRYPTION),
        leds=bool(first & _LEDS),
        bluetooth=bool(first & _BLUETOOTH),
        update=bool(first & _UPDATE),
        uwb=first & 3,
        measurement=second & 3,
    )


def decode_tag(value: bytes) -> Settings:
    """Decode the settings that a request of `cfg_tag_set` has."""
    return decode_settings(bytes((value[0], value[1] & ~(_IS_ANCHOR | _IS_INITIATOR | _IS_BRIDGE))))


def decode_anchor(value: bytes) -> Settings:
    """Decode the settings that a request of `cfg_anchor_set` has."""
    first = value[0]
    roles = _IS_ANCHOR | _IS_INITIATOR * bool(first & _INITIATOR) | _IS_BRIDGE * bool(first & _BRIDGE)
    return decode_settings(bytes((first & ~(_INITIATOR | _BRIDGE), roles)))


def encode_version(version: Version) -> bytes:
    """Return the parts of the answer to `ver_get`."""
    major, minor, patch, variant = version.firmware
    return (
        encode_part(FIRMWARE, bytes((variant, patch, minor, major)))
        + encode_part(CONFIG_VERSION, version.config.to_bytes(4, "little"))
        + encode_part(HARDWARE, version.hardware.to_bytes(4, "little"))
    )


def encode_rate(rate: UpdateRate) -> bytes:
    """Return the part of the answer to `upd_rate_get`."""
    return encode_part(UPDATE_RATE, _RATES.pack(rate.moving, rate.still))


def decode_rate(value: bytes) -> UpdateRate:
    """Decode an update rate, as `upd_rate_set` and `upd_rate_get` have it."""
    return UpdateRate(*_RATES.unpack(value))


def _common(settings: Settings) -> int:
    return (
        _ENCRYPTION * settings.encrypted
        | _LEDS * settings.leds
        | _BLUETOOTH * settings.bluetooth
        | _UPDATE * settings.update
        | settings.uwb & 3
    )


def _command(name: str, request: bytes) -> ModuleCall[None]:
    return ModuleCall(name, request, (), lambda _: None)


def _version(parts: list[tuple[int, bytes]]) -> Version:
    (_, firmware), (_, config), (_, hardware) = parts
    variant, patch, minor, major = firmware
    return Version(
        (major, minor, patch, variant & 15), int.from_bytes(config, "little"), int.from_bytes(hardware, "little")
    )


def _status(parts: list[tuple[int, bytes]]) -> ModuleStatus:
    flags = parts[0][1][0]
    return ModuleStatus(bool(flags & 1), bool(flags & 2))


POS_GET = ModuleCall("pos_get", b"\x02\x00", (POSITION_PART,), lambda parts: decode_position(parts[0][1]))
"""The place that is stored in an anchor, or that a tag has computed."""

UPD_RATE_GET = ModuleCall(
    "upd_rate_get", b"\x04\x00", (AnswerPart({UPDATE_RATE: (4,)}),), lambda parts: decode_rate(parts[0][1])
)

CFG_GET = ModuleCall("cfg_get", b"\x08\x00", (AnswerPart({CONFIG: (2,)}),), lambda parts: decode_settings(parts[0][1]))

RESET = _command("reset", b"\x14\x00")
"""The module answers, and then does not answer for about a second."""

VER_GET = ModuleCall(
    "ver_get",
    b"\x15\x00",
    (AnswerPart({FIRMWARE: (4,)}), AnswerPart({CONFIG_VERSION: (4,)}), AnswerPart({HARDWARE: (4,)})),
    _version,
)

NODE_ID_GET = ModuleCall(
    "node_id_get", b"\x30\x00", (AnswerPart({NODE_ID: (8,)}),), lambda parts: int.from_bytes(parts[0][1], "little")
)
"""The 64-bit id, DECA...; its low 16 bits are the short address."""

STATUS_GET = ModuleCall("status_get", b"\x32\x00", (AnswerPart({STATUS: (1, 2)}),), _status)

_WITHOUT_VALUE = {
    call.request: call for call in (POS_GET, UPD_RATE_GET, CFG_GET, LOC_GET, RESET, VER_GET, NODE_ID_GET, STATUS_GET)
}
_WITH_VALUE = {POS_SET: "pos_set", RATE_SET: "upd_rate_set", TAG_SET: "cfg_tag_set", ANCHOR_SET: "cfg_anchor_set"}


def call_of(request: bytes) -> ModuleCall[object]:
    """Return the call that these bytes ask for, to read its answer. Raises `FrameError` for any other (factory reset,
    keys, sleep): a robot must not lose its module by a command that came over the bus."""
    known = _WITHOUT_VALUE.get(request)
    if known is not None:
        return known
    if len(request) > 2 and request[0] in _WITH_VALUE and request[1] == MODULE_CALLS[request[0]] == len(request) - 2:
        return _command(_WITH_VALUE[request[0]], request)
    raise FrameError(f"request {request[:20].hex(' ')}: not one of the calls that are let through")
